"""Packs: files beside the database with the blocks of large snapshots, each there completely or not at all.

A pack holds what one snapshot wrote anew; the snapshot's row names the blocks of all packs that it consists of. The
bytes: magic, then for each block a head (offset in its segment, length, stored length, codec, checksum) and the block.
In a store with a key the block is sealed, and the checksum is that of what is stored: of the block it would tell.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import struct
import zlib
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from hashlib import blake2b
from typing import IO, Final

from ..encoding.compression import PLAIN, Compress, LibraryMissing, compressor, decompress
from ..journal import DamagedStore, StoreFailed
from ..snapshot.shared_blocks import PAGE, Segment, memory_file
from .sealing import Bytes, block_place
from .snapshot_files import no_link, refuse_shared, write_durably
from .store_parts import Parts

_NAME: Final = re.compile(r"[0-9a-f]+\.pack")
_MAGIC: Final = b"HFPK\x01\0\0\0"
_HEAD: Final = struct.Struct("<QIIII")  # offset, length, stored length, codec, checksum


class Packs:
    """The packs of the store at `path`, in a folder for each address."""

    def __init__(self, path: str, parts: Parts) -> None:
        self.path = path
        self.folder = f"{path}-packs"
        self._parts = parts

    def write(self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int) -> None:
        """Write a new pack durably.

        Raises:
            StoreFailed: it is not written, and nothing of it is left.
        """
        folder = self._folder(address)
        try:
            for one in (self.folder, folder):
                with contextlib.suppress(FileExistsError):
                    os.mkdir(one, mode=0o700)
                if one == self.folder:
                    self._parts.mark(one)
                if os.path.islink(one):
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), one)
            write_durably(self.file(address, number), self._packed(address, number, blocks, compressor(compress)))
        except OSError as error:
            raise StoreFailed(self.path, f"snapshot not written: {error}; older one and journal stay") from error

    def _packed(
        self, address: str, number: int, blocks: Iterable[tuple[int, memoryview]], deflate: Compress
    ) -> Iterator[Bytes]:
        yield _MAGIC
        for offset, block in blocks:
            codec, data = deflate(block)
            yield from self._stored(address, number, offset, codec, data, block)

    def _stored(self, address: str, number: int, offset: int, codec: int, data: Bytes, block: Bytes) -> Iterator[Bytes]:
        """The bytes of a block, whose `data` are what its codec has made of it."""
        cipher = self._parts.cipher
        kept = cipher.seal(block_place(address, number, offset, len(block), codec), data)
        head = _HEAD.pack(offset, len(block), len(kept), codec, 0)[:-4]
        yield head + struct.pack("<I", zlib.crc32(kept if cipher.digest_key else block, zlib.crc32(head)))
        yield kept

    def _opened(self, address: str, number: int, head: bytes, kept: bytes) -> tuple[bytes, bytes]:
        """What the codec of a block has made of it, and the block itself, verified.

        Raises:
            ValueError: it is damaged.
        """
        cipher = self._parts.cipher
        offset, length, _, codec, crc = _HEAD.unpack(head)
        data = cipher.unseal(block_place(address, number, offset, length, codec), kept)
        block = data if codec == PLAIN else decompress(codec, data, length)
        if len(block) != length or zlib.crc32(kept if cipher.digest_key else block, zlib.crc32(head[:-4])) != crc:
            raise ValueError(f"the checksum of the block at {offset} is wrong")
        return data, block

    def copied(self, source: Packs, address: str, number: int, file: IO[bytes]) -> Iterator[Bytes]:
        """The bytes of a pack of another store as it is to be in this one; what is damaged in it stays so.

        Raises:
            LibraryMissing: it is compressed.
        """
        yield file.read(len(_MAGIC))
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            offset, _, stored, codec, _ = _HEAD.unpack(head)
            kept = file.read(stored)
            try:
                data, block = source._opened(address, number, head, kept)
            except LibraryMissing:
                raise
            except ValueError:
                yield head + kept
            else:
                yield from self._stored(address, number, offset, codec, data, block)

    def read(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """Read back the blocks at these (offset, length), and verify them.

        Raises:
            DamagedStore: one is missing or damaged.
        """
        name = self.file(address, number)
        file = memory_file(number)
        try:
            for offset, block in self._blocks(address, number, set(places)):
                os.pwrite(file, block, offset)
            end = max((offset + length for offset, length in places), default=0)
            os.ftruncate(file, -(-end // PAGE) * PAGE)
            return Segment(number, file)
        except (OSError, ValueError, struct.error) as error:
            os.close(file)
            raise DamagedStore(self.path, address, None, f"snapshot file {name}: {error}") from error

    def check(self, address: str, number: int, places: Collection[tuple[int, int]]) -> None:
        """Verify the blocks at these (offset, length).

        Raises:
            DamagedStore: one is missing or damaged. StoreFailed: the library that it was compressed with is missing.
        """
        name = self.file(address, number)
        try:
            for _ in self._blocks(address, number, set(places)):
                pass
        except LibraryMissing as error:
            raise StoreFailed(self.path, str(error)) from error
        except (OSError, ValueError, struct.error) as error:
            raise DamagedStore(self.path, address, None, f"snapshot file {name}: {error}") from error

    def state(self, address: str, places: Sequence[tuple[int, int, int]]) -> bytes:
        """Put together what lies in these blocks: pack, offset, length.

        Raises:
            DamagedStore, StoreFailed: as `check`.
        """
        blocks: dict[tuple[int, int], bytes] = {}
        for number in dict.fromkeys(number for number, _, _ in places):
            name = self.file(address, number)
            wanted = {(offset, length) for pack, offset, length in places if pack == number}
            try:
                blocks.update(((number, offset), block) for offset, block in self._blocks(address, number, wanted))
            except LibraryMissing as error:
                raise StoreFailed(self.path, str(error)) from error
            except (OSError, ValueError, struct.error) as error:
                raise DamagedStore(self.path, address, None, f"snapshot file {name}: {error}") from error
        return b"".join(blocks[number, offset] for number, offset, _ in places)

    def names(self, address: str) -> set[int]:
        """The packs of an address."""
        try:
            found = os.listdir(self._folder(address))
        except FileNotFoundError:
            return set()
        return {int(name[: -len(".pack")], 16) for name in found if _NAME.fullmatch(name)}

    def remove(self, address: str, numbers: Collection[int]) -> None:
        """Remove packs that no snapshot needs.

        Raises:
            StoreFailed: some of them are left.
        """
        with self._refusing():
            for number in numbers:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(self.file(address, number))

    def erase(self, address: str) -> None:
        """Remove all packs of an address, and what was left half made.

        Raises:
            StoreFailed: some of them are left.
        """
        folder = self._folder(address)
        with self._refusing(), contextlib.suppress(FileNotFoundError):
            for name in os.listdir(folder):
                if _NAME.fullmatch(name.removesuffix(".tmp")):
                    with contextlib.suppress(FileNotFoundError):
                        os.unlink(os.path.join(folder, name))
            if not os.listdir(folder):  # Else somebody has put something there that is not ours.
                os.rmdir(folder)

    @contextlib.contextmanager
    def _refusing(self) -> Generator[None, None, None]:
        try:
            yield
        except OSError as error:
            raise StoreFailed(self.path, f"{error}; blocks of snapshots are left behind") from error

    def _folder(self, address: str) -> str:
        data, key = address.encode(errors="surrogatepass"), self._parts.cipher.digest_key
        return os.path.join(self.folder, blake2b(data, digest_size=12, key=key).hexdigest())

    def file(self, address: str, number: int) -> str:
        """The file in which a pack of an address is kept."""
        return os.path.join(self._folder(address), f"{number:x}.pack")

    def _blocks(self, address: str, number: int, wanted: set[tuple[int, int]]) -> Iterator[tuple[int, bytes]]:
        """The verified blocks of a pack that are wanted, as (offset, length), each with its offset.

        Raises:
            OSError, ValueError, struct.error: one is missing or damaged.
        """
        name = self.file(address, number)
        with open(name, "rb", opener=no_link) as pack:
            refuse_shared(name, os.fstat(pack.fileno()))
            if pack.read(len(_MAGIC)) != _MAGIC:
                raise ValueError("it is no pack")
            while wanted and (head := pack.read(_HEAD.size)):
                offset, length, stored, _, _ = _HEAD.unpack(head)
                kept = pack.read(stored)
                if (offset, length) in wanted:
                    yield offset, self._opened(address, number, head, kept)[1]
                    wanted.discard((offset, length))
        if wanted:
            raise ValueError(f"the block at {min(wanted)[0]} is missing")

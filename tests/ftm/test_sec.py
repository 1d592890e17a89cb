"""Secured links with real processes, and an attacker who sits on them."""

from __future__ import annotations

import asyncio
import os
import signal
import stat
import subprocess
import sys
from collections import Counter as Counts
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.exit_reasons import SHUTDOWN, pack_exit
from holdfast.actors.kernel.codec import Parcel
from holdfast.actors.kernel.envelope import Envelope
from holdfast.actors.process.stand_ins import Inner
from holdfast.checkpoint.protocol import Closed
from holdfast.ftm.bricks.brick_messages import Done, Follow, Lead, Work
from holdfast.ftm.bricks.replica_orders import Export, Join, SetPeer
from holdfast.ftm.bricks.sealed_frames import TELLS, Agree, Back, Call, Greet, LinkLost, Opened, Part, Refused, Sealed
from holdfast.ftm.mechanisms.sec import SEC
from holdfast.ftm.mechanisms.tmr import TMR
from holdfast.ftm.model.mechanism import MechanismRefused
from holdfast.ftm.replica.replica import weave
from holdfast.ftm.sec.authority import CertificationAuthority, Enrol, GetRoot
from holdfast.ftm.sec.certificates import Trust, make_request
from holdfast.ftm.sec.handshake import Participant
from holdfast.ftm.sec.identity import root_file
from holdfast.ftm.sec.keys import SigningKey
from holdfast.ftm.sec.sec_errors import EnrolmentRefused
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.sec.parties import Office

pytestmark = pytest.mark.usefixtures("warm_programs")

CA = "/app/ca"


def group_of(ref: Any) -> Any:
    return ref._cell.host.place.group


async def joined(ref: Any, count: int = 2) -> None:
    async with asyncio.timeout(20):
        while group_of(ref) is None or len(group_of(ref).membership.members) < count:
            await asyncio.sleep(0.005)


async def kill_primary(system: hf.ActorSystem, ref: Any) -> None:
    """Returns when another one leads."""
    before = group_of(ref).failovers
    os.kill(system._workers.processes()[f"{ref.path}/ftm/{group_of(ref).membership.primary}"], signal.SIGKILL)
    async with asyncio.timeout(20):
        while group_of(ref).failovers == before:
            await asyncio.sleep(0.002)


STACKS: dict[str, Callable[[], tuple[Any, ...]]] = {
    "SEC": lambda: (SEC(CA),),
    "SEC over PBR": lambda: (SEC(CA), hf.ftm.PBR()),
    "SEC over LFR": lambda: (SEC(CA), hf.ftm.LFR()),
    "SEC over PBR over TR": lambda: (SEC(CA), hf.ftm.PBR(), hf.ftm.TR()),
    "SEC over TMR": lambda: (SEC(CA), TMR()),
}


@pytest.mark.parametrize("name", STACKS)
async def test_requests_are_answered_over_it(secured: hf.ActorSystem, name: str) -> None:
    """A73, A74, A66, A71."""
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(STACKS[name]())))
    replies = await asyncio.gather(*[ref.ask(Add(n), timeout=20.0) for n in range(200)])
    assert replies == list(range(1, 201))
    assert group_of(ref).replicas.link is not None


@pytest.mark.parametrize("name", [name for name in STACKS if name != "SEC"])
async def test_kills_of_the_one_that_leads_lose_and_double_nothing(secured: hf.ActorSystem, name: str) -> None:
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(STACKS[name]())))
    asked: list[asyncio.Future[int]] = []
    for round_ in range(3):
        await joined(ref)
        for n in range(100):
            asked.append(ref.ask(Add(100 * round_ + n), timeout=20.0))
            if n % 10 == 0:
                await asyncio.sleep(0.001)
        await kill_primary(secured, ref)
    assert await asyncio.gather(*asked) == list(range(1, 301))
    assert await ref.ask(Tags()) == list(range(300))


class Tap:
    """Sits where all messages to bricks of replicas, and to the proxy, come by: in the root, on their way."""

    def __init__(self) -> None:
        self.strike: Callable[[str, bytes], bytes | None] = lambda path, frame: frame
        self.seen: list[tuple[str, Any]] = []
        self.own: set[bytes] = set()

    def on_replicas(self, monkeypatch: pytest.MonkeyPatch) -> Tap:
        real = Inner._admit

        def admit(inner: Inner, cell: Any, item: Any) -> None:
            self.pass_on(cell, item, lambda: real(inner, cell, item))

        monkeypatch.setattr(Inner, "_admit", admit)
        return self

    def on_proxy(self, ref: Any) -> Tap:
        cell = group_of(ref).replicas.cell_of("proxy")
        real = cell.admit
        cell.admit = lambda cell, item: self.pass_on(cell, item, lambda: real(cell, item))
        return self

    def pass_on(self, cell: Any, item: Any, go_on: Callable[[], None]) -> None:
        message = getattr(item, "message", item)
        self.seen.append((cell.path, message))
        if isinstance(message, Parcel) and message.name.endswith((":Sealed", ":Letter")):
            new: Any = self.strike(cell.path, message.body)
            new = message.body if new is SWALLOWED else new
            item.message = None if new is None else Parcel(message.name, new)
        elif isinstance(message, Sealed) and message.frame not in self.own:
            new = self.strike(cell.path, message.frame)
            if new is SWALLOWED:  # It arrives, and whoever has sent it does not hear so.
                self.own.add(message.frame)
                cell.ref.ask(message).add_done_callback(lambda done: done.exception())
                return
            item.message = None if new is None else Sealed(new)
        if getattr(item, "message", item) is not None:
            go_on()


def every(count: int, harm: Callable[[bytes], bytes | None]) -> Callable[[str, bytes], bytes | None]:
    """Harms every so many frames of each path."""
    counts: Counts[str] = Counts()

    def strike(path: str, frame: bytes) -> bytes | None:
        counts[path] += 1
        return harm(frame) if counts[path] % count == 0 else frame

    return strike


def flip(frame: bytes) -> bytes:
    """One bit of what is sealed is another one."""
    return frame[:-30] + bytes([frame[-30] ^ 4]) + frame[-29:]


SWALLOWED = b"swallowed"
REFUSALS: dict[str, tuple[Callable[[bytes], bytes | None], str]] = {
    "altered": (flip, "forged"),
    "dropped": (lambda frame: None, ""),
    "unanswered": (lambda frame: SWALLOWED, ""),
}


@pytest.mark.parametrize("harm", REFUSALS)
@pytest.mark.parametrize("name", ["SEC over PBR", "SEC over LFR"])
@pytest.mark.some(3)
async def test_what_is_altered_or_dropped_on_the_way_is_said_again(
    secured: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, name: str, harm: str
) -> None:
    """T47: on all links, both ways; honest requests go on, once each."""
    tap = Tap().on_replicas(monkeypatch)
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(STACKS[name]())))
    await joined(ref)
    tap.on_proxy(ref)
    work, reason = REFUSALS[harm]
    with secured.events() as events:
        tap.strike = every(7, work)
        replies = [await ref.ask(Add(n), timeout=30.0) for n in range(20)]
        tap.strike = lambda path, frame: frame
        assert replies == list(range(1, 21))
        assert await ref.ask(Tags()) == list(range(20))
        if reason:
            async with asyncio.timeout(10):
                places: set[str] = set()
                while len(places) < 3:
                    places |= {one.place for one in events.take() if isinstance(one, hf.events.FrameRefused)}
                    await asyncio.sleep(0.01)
            assert places == {f"/app/c/ftm/{place}" for place in ("proxy", "r1", "r2")}
            assert group_of(ref).replicas.link.rejected[reason] > 0


async def test_what_is_replayed_is_refused(secured: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    tap = Tap().on_replicas(monkeypatch)
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(SEC(CA), hf.ftm.PBR())))
    await joined(ref)
    tap.on_proxy(ref)
    assert await ref.ask(Add(0)) == 1
    node = secured._node
    frames = [(path, message.frame) for path, message in tap.seen if isinstance(message, Sealed)]
    assert {path.rpartition("/ftm/")[2] for path, _ in frames} >= {"proxy", "r1/protocol"}
    for path, frame in frames:
        with pytest.raises(Refused, match=r"replayed|wrong_session"):
            await node.cell_at(path).ref.ask(Sealed(frame))
    letters = [(path, m) for path, m in tap.seen if isinstance(m, Parcel) and m.name.endswith(":Letter")]
    assert letters
    assert await ref.ask(Tags()) == [0]
    assert group_of(ref).replicas.link.rejected["replayed"] > 0


@pytest.mark.parametrize(("below", "count"), [(hf.ftm.PBR(), 2), (TMR(), 3)])
async def test_nothing_can_be_read_on_the_way(
    secured: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, below: Any, count: int
) -> None:
    """Between proxy and replicas, and from each replica to each other."""
    tap = Tap().on_replicas(monkeypatch)
    plain = await secured.start(hf.child("p", hf.start(Counter), mechanism=below))
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(SEC(CA), below)))
    await joined(plain, count)
    await joined(ref, count)
    tap.on_proxy(ref)
    assert await plain.ask(Add(1)) == await ref.ask(Add(1)) == 1

    def seen(path: str) -> bytes:
        said = [m for where, m in tap.seen if where.startswith(path)]
        return b"".join(m.body if isinstance(m, Parcel) else repr(m).encode() for m in said)

    assert b"accounts:Add" in seen("/app/p")
    assert b"accounts:Add" not in seen("/app/c")
    others = [f"r{number}" for number in range(1, count + 1) if f"r{number}" != group_of(ref).membership.primary]
    letters = [where for where, m in tap.seen if isinstance(m, Parcel) and m.name.endswith(":Letter")]
    assert {where.split("/")[4] for where in letters if where.startswith("/app/c/ftm/r")} >= set(others)
    assert not [m for where, m in tap.seen if where.startswith("/app/c") and isinstance(m, (Work, Lead, Join, Done))]


class Client(hf.Actor):
    """Lives in a process of its own."""

    counter: hf.Binding[Counter]

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        return await self.counter.ask(message)


async def test_a_client_in_another_process_is_answered_and_the_links_behind_the_proxy_are_sealed(
    secured: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A66: the link begins where requests enter, at the proxy; it is in the root, to which clients have own pipes."""
    tap = Tap().on_replicas(monkeypatch)
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(SEC(CA), hf.ftm.PBR())))
    await joined(ref)
    tap.on_proxy(ref)
    spec = hf.child("client", hf.start(Client), isolation="process", bindings={"counter": "/app/c"})
    client = await secured.start(spec)
    assert [await client.ask(Add(n)) for n in range(5)] == [1, 2, 3, 4, 5]
    os.kill(secured.pid_of(client), signal.SIGKILL)
    assert await secured.ref("/app/client", Client).ask(Add(5), timeout=20.0) == 6
    said = [m.body if isinstance(m, Parcel) else repr(m).encode() for where, m in tap.seen if "/app/c/" in where]
    assert not [one for one in said if b"accounts:Add" in one]
    assert await ref.ask(Tags()) == [0, 1, 2, 3, 4, 5]


async def test_what_is_forged_is_refused(secured: hf.ActorSystem) -> None:
    """Plain words, rubbish, and participants that are others."""
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(SEC(CA), hf.ftm.PBR())))
    await joined(ref)
    group, node = group_of(ref), secured._node
    protocol = node.cell_at("/app/c/ftm/r1/protocol").ref
    with secured.events() as events:
        for order in (
            Lead(99, group.adaptation.config),
            Follow(99, group.adaptation.config),
            SetPeer(99, None),
            Export(group.membership.epoch),
        ):
            with pytest.raises(Refused, match="plain"):
                await protocol.ask(order)
        protocol.tell(Work(group.membership.epoch, group.adaptation.config, 99, []))
        over = Closed(0, dict(pack_exit(SHUTDOWN)), False)
        end = Done(group.membership.epoch, group.adaptation.config, group.delivery.number, [], True, None, [over])
        proxy = node.cell_at("/app/c/ftm/proxy")
        proxy.ref.tell(end)
        proxy.admit(proxy, Envelope(end, node.cell_at("/app/c/ftm/r1/protocol")))  # As whoever leads would send it.
        for frame in (b"", b"rubbish", os.urandom(100)):
            with pytest.raises(Refused, match="wrong_session"):
                await protocol.ask(Sealed(frame))
        with pytest.raises(Refused, match="forged"):
            await protocol.ask(Opened(0))
        with pytest.raises(Refused, match="untrusted"):
            await protocol.ask(Greet(Office().party("/app/c/ftm/proxy").begin("/app/c/ftm/r1").hello))
        key, ca = SigningKey.per_start(), secured.ref(CA, CertificationAuthority)
        certificate = await ca.ask(Enrol(make_request(key, "mallory")))
        mallory = Participant(
            key, certificate, Trust(await ca.ask(GetRoot())), incarnation=1, epoch=group.membership.epoch
        )
        with pytest.raises(Refused, match="wrong_peer"):
            await protocol.ask(Greet(mallory.begin("/app/c/ftm/r1").hello))
        with pytest.raises(EnrolmentRefused):
            await ca.ask(Enrol(make_request(key, "/app/c/ftm/proxy")))
        reasons: set[str] = set()
        async with asyncio.timeout(10):
            while reasons < {"plain", "wrong_session", "untrusted", "wrong_peer"}:
                reasons |= {one.reason for one in events.take() if isinstance(one, hf.events.FrameRefused)}
                await asyncio.sleep(0.01)
    assert await ref.ask(Add(1)) == 1
    assert (group_of(ref).membership.epoch, ref._cell.life) == (1, 1)


async def test_frames_at_a_replica_without_a_secured_link_are_refused_and_harm_nobody(secured: hf.ActorSystem) -> None:
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.PBR()))
    await joined(ref)
    lives = dict(group_of(ref).membership.members)
    for name in ("r1", "r2"):
        protocol = secured._node.cell_at(f"/app/c/ftm/{name}/protocol").ref
        for frame in (Greet(b"hello"), Agree(b"hello", b"finish"), Sealed(b"frame")):
            with pytest.raises(Refused, match="closed"):
                await protocol.ask(frame)
    assert await ref.ask(Add(1)) == 1
    assert group_of(ref).membership.members == lives


async def test_keys_rotate_sessions_end_and_each_epoch_has_its_own(secured: hf.ActorSystem) -> None:
    sec = SEC(CA, rotate_messages=3, lifetime=0.3)
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(sec, hf.ftm.PBR())))
    await joined(ref)
    link, numbers, generations = group_of(ref).replicas.link, set(), set()
    for n in range(150):
        assert await ref.ask(Add(n), timeout=20.0) == n + 1
        session = link._partners["/app/c/ftm/r1"].session
        numbers.add(session.number)
        generations.add(session.generation)
        await asyncio.sleep(0.005)
    assert len(numbers) > 1
    assert max(generations) > 1
    await kill_primary(secured, ref)
    assert await ref.ask(Add(150), timeout=20.0) == 151
    assert link._partners["/app/c/ftm/r2"].session.epoch == group_of(ref).membership.epoch == 2
    assert not [one for one in link._sessions.values() if one.is_open and one.epoch < 2]


async def test_keys_are_files_of_ours_alone_and_in_no_recipe(secured: hf.ActorSystem) -> None:
    sec = SEC(CA)
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(sec, hf.ftm.PBR())))
    await joined(ref)
    folder = Path(sec.folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()} == {0o600}
    said = repr(sec) + repr(sec.describe()) + repr(vars(group_of(ref))) + repr(ref._cell.extra().start)
    for file in folder.glob("*.key"):
        body = file.read_text().splitlines()[1]
        assert body not in said
    assert b"PRIVATE" not in said.encode()


async def test_a_link_among_the_keys_is_refused_and_where_it_leads_nothing_changes(
    secured: hf.ActorSystem, tmp_path: Path
) -> None:
    keys, foreign = tmp_path / "keys", tmp_path / "foreign"
    keys.mkdir(mode=0o700)
    foreign.write_text("mine")
    root_file(str(keys), CA).symlink_to(foreign)
    with pytest.raises(hf.HoldfastError, match=r"root is not used: .*symbolic links"):
        await secured.start(
            hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(SEC(CA, keys=str(keys)), hf.ftm.PBR()))
        )
    assert root_file(str(keys), CA).is_symlink()
    assert foreign.read_text() == "mine"


def test_a_directory_of_keys_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "keys").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to(tmp_path / "keys")
    with pytest.raises(MechanismRefused, match="links are not followed"):
        SEC(CA, keys=str(tmp_path / "link")).check(Counter)


def test_at_the_end_only_the_keys_of_the_start_are_removed(tmp_path: Path) -> None:
    program = """
import pathlib, sys
import holdfast as hf
from holdfast.ftm.sec.participants import key_file
from holdfast.ftm.sec.keys import SigningKey
folder = pathlib.Path(hf.ftm.SEC("/app/authority").folder)
SigningKey.from_file(key_file(str(folder), "/app/c"))
assert len(list(folder.iterdir())) == 1
if "foreign" in sys.argv:
    (folder / "mine").write_text("mine")
print(folder)
"""
    for args, left in ([], []), (["foreign"], ["mine"]):
        run = [sys.executable, "-c", program, *args]
        done = subprocess.run(run, env={**os.environ, "TMPDIR": str(tmp_path)}, capture_output=True, check=True)
        folder = Path(done.stdout.decode().strip())
        assert folder.parent == tmp_path
        assert folder.exists() is bool(left)
        assert [file.name for file in folder.glob("*")] == left


def test_keys_of_killed_processes_are_removed_by_the_next_that_has_some(tmp_path: Path) -> None:
    """Of none that lives, and nothing that a process of another machine, or somebody else, has put there."""
    program = """
import holdfast as hf
from holdfast.ftm.sec.participants import key_file
from holdfast.ftm.sec.keys import SigningKey
sec = hf.ftm.SEC("/app/authority")
input()
SigningKey.from_file(key_file(sec.folder, "/app/c"))
print(sec.folder, flush=True)
input()
"""
    foreign = {tmp_path / name for name in ("holdfast-sec-abcdefgh", "holdfast-sec-0123456789ab-999999999-1-abcdefgh")}
    for folder in foreign:
        folder.mkdir(mode=0o700)

    def there() -> set[Path]:
        return set(tmp_path.iterdir()) - foreign

    def begun() -> subprocess.Popen[str]:
        environment = {**os.environ, "TMPDIR": str(tmp_path)}
        return subprocess.Popen(
            [sys.executable, "-c", program], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def made(process: subprocess.Popen[str]) -> Path:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("\n")
        process.stdin.flush()
        return Path(process.stdout.readline().strip())

    processes = [begun() for _ in range(3)]
    try:
        killed, living, later = processes
        first = made(killed)
        assert there() == {first}, "it is made when it is needed"
        killed.kill()
        killed.wait(30)
        second = made(living)
        assert there() == {second}
        third = made(later)
        assert there() == {second, third}
        for process in (living, later):
            process.communicate("\n", timeout=30)
        assert there() == set()
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    assert all(folder.exists() for folder in foreign)


@pytest.mark.parametrize("mode", [0o755, 0o770])
def test_a_directory_that_others_can_enter_is_refused(tmp_path: Path, mode: int) -> None:
    tmp_path.chmod(mode)
    with pytest.raises(MechanismRefused, match="0700"):
        SEC(CA, keys=str(tmp_path)).check(Counter)


async def test_it_stands_outermost(secured: hf.ActorSystem) -> None:
    """A66."""
    with pytest.raises(MechanismRefused, match="outermost"):
        weave((hf.ftm.PBR(), SEC(CA)), leads=True)


async def test_without_its_authority_it_does_not_start(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.StartFailed, match=f"no authority lives at {CA}: start a CertificationAuthority there"):
        await system.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(SEC(CA), hf.ftm.PBR())))


async def test_a_replica_joins_after_the_death_of_an_authority_that_is_saved(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """A68: its key is in a file, and what it has issued in a snapshot after each message."""
    start, saved = hf.start(CertificationAuthority, str(tmp_path / "ca.key")), hf.checkpoint_only(every=1)
    authority = await system.start(hf.child("ca", start, recovery=saved))
    ref = await system.start(hf.child("c", hf.start(Counter), mechanism=(SEC(CA), hf.ftm.PBR())))
    await joined(ref)
    await system.terminate(authority, hf.Crash("ValueError", "boom"))
    await kill_primary(system, ref)
    assert await ref.ask(Add(1), timeout=20.0) == 1
    await joined(ref)


@pytest.mark.parametrize(
    "wrong", [{"authority": "ca"}, {"rotate_messages": 0}, {"rotate_seconds": -1.0}, {"suites": ("rot13",)}]
)
def test_settings_that_mean_nothing_are_refused(wrong: dict[str, Any]) -> None:
    settings: dict[str, Any] = {"authority": CA, **wrong}
    with pytest.raises(ValueError, match=r"SEC: .*(must be|there are)"):
        SEC(**settings)


async def test_an_authority_that_is_another_one_is_not_believed(secured: hf.ActorSystem) -> None:
    """A70."""
    with pytest.raises(hf.HoldfastError, match="untrusted"):
        await secured.start(hf.child("c", hf.start(Counter), mechanism=SEC(CA, fingerprint="00" * 8)))


async def test_attached_composed_and_detached_while_requests_flow(secured: hf.ActorSystem) -> None:
    ref = await secured.start(hf.child("c", hf.start(Counter), recovery=hf.hybrid()))
    load = Load(ref)
    await load.reached(20)
    async with secured.transaction(timeout=30) as change:
        change.protect(ref, hf.ftm.PBR())
    await load.reached(20)
    async with secured.transaction(timeout=30) as change:
        change.protect(ref, (SEC(CA), "pbr"))
    assert group_of(ref).replicas.link is not None
    await load.reached(20)
    await kill_primary(secured, ref)
    await load.reached(20)
    await joined(ref)
    async with secured.transaction(timeout=30) as change:
        change.protect(ref, "pbr")
    assert group_of(ref).replicas.link is None
    await load.reached(20)
    async with secured.transaction(timeout=30) as change:
        change.protect(ref, hf.ftm.compose(SEC(CA), hf.ftm.PBR()))
    await load.reached(20)
    async with secured.transaction(timeout=30) as change:
        change.protect(ref, None)
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))


def test_it_can_be_named_without_the_extra_and_says_what_is_missing() -> None:
    code = """
import importlib.util, sys
real = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == "cryptography" else real(name, *more)
import holdfast as hf
try:
    hf.ftm.SEC("/app/ca").check(hf.Actor)
except hf.errors.MechanismRefused as error:
    print(error)
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60).stdout
    assert "holdfast[sec]" in out


async def test_what_comes_twice_is_done_once_in_order(secured: hf.ActorSystem) -> None:
    """A frame whose answer was lost, or that came before another one, is sealed anew and sent again."""
    sec, node = SEC(CA), secured._node
    inner = sec.open_link(node, "/app/c", "/app/c/ftm/r1", lambda: 1)
    outer = sec.open_link(node, "/app/c", "/app/c/ftm/proxy", lambda: 1, lambda: ["/app/c/ftm/r1"])
    await outer.ready()
    done: list[bytes] = []
    lost: list[bool] = []
    tried: list[bytes] = []

    async def handle(call: Call) -> Back:
        done.extend(part.body for part in call.parts)
        return Back("reply", "", call.parts[0].body)

    async def reach(message: Any, seconds: float) -> Any:
        if isinstance(message, Greet):
            return await inner.greet(message.hello)
        if isinstance(message, Agree):
            return await inner.agree(message.hello, message.finish)
        tried.append(message.frame)
        if len(tried) % 4 == 1:  # Those behind it come first.
            raise hf.AskTimeout("r1", seconds)
        reply = await inner.take(message.frame, handle)
        lost.append(len(lost) % 3 != 2)
        if lost[-1]:
            raise hf.AskTimeout("r1", seconds)
        return reply

    asked = [outer.call("/app/c/ftm/r1", TELLS, Part("", b"%d" % n), reach, lambda: True) for n in range(9)]
    backs = await asyncio.gather(*asked)
    assert [back.body for back in backs] == [b"%d" % n for n in range(9)] == done
    assert len(lost) > 9
    outer.close()
    inner.close()
    with pytest.raises(LinkLost):
        await outer.call("/app/c/ftm/r1", TELLS, Part("", b""), reach, lambda: True)

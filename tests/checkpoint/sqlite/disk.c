/* Preloaded: notes each write, truncation, sync, rename and removal below $DISK_ROOT in $DISK_LOG, in order.
 * The $DISK_FAIL-th sync (from 1; 0: none) and all after it fail with EIO. `steps_left` (0: no end) counts the steps
 * until the process is killed; a write has two: half of it, and the rest. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int out = -1;
static long syncs;
long steps_left;

static int is_last(void) { return steps_left > 0 && --steps_left == 0; }

static void die(void) {
    kill(getpid(), SIGKILL);
    for (;;) pause();
}

static int inside(const char *path) {
    const char *root = getenv("DISK_ROOT");
    return root && !strncmp(path, root, strlen(root));
}

static int named(int fd, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t size = readlink(link, path, 4095);
    if (size < 0) return 0;
    path[size] = 0;
    return inside(path) && !strstr(path, "-shm");
}

static void note(char op, const char *path, int64_t at, const void *data, int64_t size) {
    static ssize_t (*real_writev)(int, const struct iovec *, int);
    if (!real_writev) real_writev = dlsym(RTLD_NEXT, "writev");
    if (out < 0) out = open(getenv("DISK_LOG"), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    int64_t head[3] = {(int64_t)strlen(path), at, size};
    struct iovec parts[] = {{&op, 1}, {head, sizeof head}, {(void *)path, head[0]}, {(void *)data, (size_t)size}};
    if (real_writev(out, parts, size ? 4 : 3) < 0) abort();
    if (is_last()) die();
}

#define REAL(name, type, ...) static type (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, #name)

static ssize_t written(int fd, const void *data, ssize_t done, off_t at) {
    char path[4096];
    if (done > 0 && named(fd, path)) {
        if (at < 0) at = lseek(fd, 0, SEEK_CUR) - done;
        note('w', path, at, data, done);
    }
    return done;
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t at) {
    REAL(pwrite, ssize_t, int, const void *, size_t, off_t);
    char path[4096];
    pthread_mutex_lock(&lock);
    if (steps_left && named(fd, path) && is_last()) {
        if (real(fd, data, size / 2, at) >= 0) die();
    }
    ssize_t done = written(fd, data, real(fd, data, size, at), at);
    pthread_mutex_unlock(&lock);
    return done;
}

ssize_t pwrite64(int fd, const void *data, size_t size, off_t at) { return pwrite(fd, data, size, at); }

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write, ssize_t, int, const void *, size_t);
    pthread_mutex_lock(&lock);
    ssize_t done = written(fd, data, real(fd, data, size), -1);
    pthread_mutex_unlock(&lock);
    return done;
}

int ftruncate(int fd, off_t size) {
    REAL(ftruncate, int, int, off_t);
    char path[4096];
    pthread_mutex_lock(&lock);
    int result = real(fd, size);
    if (!result && named(fd, path)) note('t', path, size, "", 0);
    pthread_mutex_unlock(&lock);
    return result;
}

int ftruncate64(int fd, off_t size) { return ftruncate(fd, size); }

static int synced(int fd, int (*real)(int)) {
    char path[4096];
    if (!named(fd, path)) return real(fd);
    pthread_mutex_lock(&lock);
    long fail = atol(getenv("DISK_FAIL"));
    int result = 0;
    if (fail && ++syncs >= fail) {
        errno = EIO;
        result = -1;
    } else {
        note('s', path, 0, "", 0); /* not really: nobody pulls the plug of this machine */
    }
    pthread_mutex_unlock(&lock);
    return result;
}

int fsync(int fd) {
    REAL(fsync, int, int);
    return synced(fd, real);
}

int fdatasync(int fd) {
    REAL(fdatasync, int, int);
    return synced(fd, real);
}

int unlink(const char *path) {
    REAL(unlink, int, const char *);
    int result = real(path);
    if (!result && inside(path) && !strstr(path, "-shm")) {
        pthread_mutex_lock(&lock);
        note('u', path, 0, "", 0);
        pthread_mutex_unlock(&lock);
    }
    return result;
}

int rename(const char *from, const char *to) {
    REAL(rename, int, const char *, const char *);
    int result = real(from, to);
    if (!result && inside(from)) {
        pthread_mutex_lock(&lock);
        note('r', from, 0, to, (int64_t)strlen(to));
        pthread_mutex_unlock(&lock);
    }
    return result;
}

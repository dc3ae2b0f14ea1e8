/* Loaded before the C library (LD_PRELOAD): lets the Nth write under a folder, and all that follow, fail or kill the process.

   A write is what changes a file system: open to write, write, fsync, rename, mkdir. Armed by fault_arm(), or from the start by
   FAULT_UNDER, FAULT_NTH and FAULT_ERRNO (0: SIGKILL) in the environment.

   With FAULT_MEMORY=N there, the Nth large block of memory that is asked for, and all that follow, are refused. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <malloc.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static char under[PATH_MAX];
static long nth, seen;
static int number;
static long refused_from, blocks;

void fault_arm(const char *folder, long n, int error) {
    snprintf(under, sizeof under, "%s", folder);
    nth = n, number = error;
    __atomic_store_n(&seen, 0, __ATOMIC_SEQ_CST);
}

long fault_seen(void) { return __atomic_load_n(&seen, __ATOMIC_SEQ_CST); }

__attribute__((constructor)) static void from_environment(void) {
    const char *folder = getenv("FAULT_UNDER"), *n = getenv("FAULT_NTH"), *error = getenv("FAULT_ERRNO");
    if (folder && n && error) fault_arm(folder, atol(n), atoi(error));
    if (getenv("FAULT_MEMORY")) refused_from = atol(getenv("FAULT_MEMORY"));
}

static int fails(const char *path) {
    size_t length = strlen(under);
    if (!length || !path || strncmp(path, under, length)) return 0;
    long now = __atomic_add_fetch(&seen, 1, __ATOMIC_SEQ_CST);
    if (!nth || now < nth) return 0;
    if (!number) kill(getpid(), SIGKILL);
    errno = number;
    return 1;
}

static int fails_at(int folder, const char *path) {
    char link[64], full[2 * PATH_MAX];
    if (path && path[0] == '/') return fails(path);
    snprintf(link, sizeof link, folder == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", folder);
    ssize_t length = readlink(link, full, PATH_MAX - 1);
    if (length < 0) return 0;
    full[length] = 0;
    if (path) snprintf(full + length, PATH_MAX, "/%s", path);
    return fails(full);
}

#define REAL(name) static __typeof__(&name) real; if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
#define WRITES(flags) ((flags) & (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC))

#define OPEN(name)                                                                          \
    int name(const char *path, int flags, ...) {                                            \
        va_list more; va_start(more, flags); mode_t mode = va_arg(more, int); va_end(more); \
        REAL(name);                                       \
        return WRITES(flags) && fails_at(AT_FDCWD, path) ? -1 : real(path, flags, mode);    \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                                        \
    int name(int at, const char *path, int flags, ...) {                                    \
        va_list more; va_start(more, flags); mode_t mode = va_arg(more, int); va_end(more); \
        REAL(name);                                  \
        return WRITES(flags) && fails_at(at, path) ? -1 : real(at, path, flags, mode);      \
    }
OPENAT(openat)
OPENAT(openat64)

#define FOPEN(name)                                                          \
    FILE *name(const char *path, const char *mode) {                         \
        REAL(name);                  \
        return strpbrk(mode, "wa+") && fails_at(AT_FDCWD, path) ? NULL : real(path, mode); \
    }
FOPEN(fopen)
FOPEN(fopen64)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write);
    return fails_at(fd, NULL) ? -1 : real(fd, data, size);
}

#define PWRITE(name, offset_t)                                                    \
    ssize_t name(int fd, const void *data, size_t size, offset_t at) {            \
        REAL(name);            \
        return fails_at(fd, NULL) ? -1 : real(fd, data, size, at);                \
    }
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

ssize_t writev(int fd, const struct iovec *parts, int count) {
    REAL(writev);
    return fails_at(fd, NULL) ? -1 : real(fd, parts, count);
}

int fsync(int fd) {
    REAL(fsync);
    return fails_at(fd, NULL) ? -1 : real(fd);
}

int rename(const char *from, const char *to) {
    REAL(rename);
    return fails_at(AT_FDCWD, to) ? -1 : real(from, to);
}

int renameat(int from_at, const char *from, int to_at, const char *to) {
    REAL(renameat);
    return fails_at(to_at, to) ? -1 : real(from_at, from, to_at, to);
}

int mkdir(const char *path, mode_t mode) {
    REAL(mkdir);
    return fails_at(AT_FDCWD, path) ? -1 : real(path, mode);
}

int mkdirat(int at, const char *path, mode_t mode) {
    REAL(mkdirat);
    return fails_at(at, path) ? -1 : real(at, path, mode);
}

#define LARGE (1 << 18)

static int refused(size_t size) {
    return refused_from && size >= LARGE && __atomic_add_fetch(&blocks, 1, __ATOMIC_SEQ_CST) >= refused_from;
}

extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t), *__libc_memalign(size_t, size_t);

#define ALLOCATES(head, size, call)     \
    head {                              \
        if (!refused(size)) return call; \
        errno = ENOMEM;                 \
        return NULL;                    \
    }
ALLOCATES(void *malloc(size_t size), size, __libc_malloc(size))
ALLOCATES(void *calloc(size_t count, size_t size), count * size, __libc_calloc(count, size))
ALLOCATES(void *realloc(void *block, size_t size), size, __libc_realloc(block, size))
ALLOCATES(void *memalign(size_t alignment, size_t size), size, __libc_memalign(alignment, size))
ALLOCATES(void *aligned_alloc(size_t alignment, size_t size), size, __libc_memalign(alignment, size))

int posix_memalign(void **block, size_t alignment, size_t size) {
    if (refused(size)) return ENOMEM;
    void *found = __libc_memalign(alignment, size);
    if (found) *block = found;
    return found ? 0 : ENOMEM;
}

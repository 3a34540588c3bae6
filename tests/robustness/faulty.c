/* Writes that fail: preloaded into a process, which arms it with faulty(). */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OFF, SHORT, FULL, FULL_ONCE, BROKEN_ONCE, PART_ONCE };
static char folder[4096];
static long left;
static int kind, hits;

/* After so many bytes into files under a folder, a write fails in one of the ways. */
void faulty(const char *where, long after, int how) {
    strncpy(folder, where, sizeof folder - 1);
    left = after, kind = how, hits = 0;
}

int faulty_hits(void) { return hits; }

static int watched(int fd) {
    char link[64], path[4096];
    if (kind == OFF || fd < 0) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return strncmp(path, folder, strlen(folder)) == 0;
}

/* How much of n bytes may be written; -1: none, with errno set. */
static ssize_t allowed(size_t n) {
    if ((long)n <= left) { left -= n; return n; }
    hits++;
    ssize_t part = left;
    left = 0;
    if (kind == SHORT) { kind = OFF; return part > 0 ? part : 1; }
    if ((kind == FULL || kind == PART_ONCE) && part > 0) return part;
    errno = kind == BROKEN_ONCE ? EIO : ENOSPC;
    if (kind != FULL) kind = OFF;
    return -1;
}

#define REAL(name) static __typeof__(&name) real; if (!real) real = dlsym(RTLD_NEXT, #name)

ssize_t write(int fd, const void *data, size_t n) {
    REAL(write);
    if (n && watched(fd)) { ssize_t may = allowed(n); return may < 0 ? -1 : real(fd, data, may); }
    return real(fd, data, n);
}

ssize_t pwrite64(int fd, const void *data, size_t n, off64_t at) {
    REAL(pwrite64);
    if (n && watched(fd)) { ssize_t may = allowed(n); return may < 0 ? -1 : real(fd, data, may, at); }
    return real(fd, data, n, at);
}

ssize_t writev(int fd, const struct iovec *parts, int count) {
    REAL(writev);
    if (watched(fd))
        for (int k = 0; k < count; k++)
            if (parts[k].iov_len) return write(fd, parts[k].iov_base, parts[k].iov_len);
    return real(fd, parts, count);
}

/* The C library goes on after a short write by itself, so one that is no error is not seen here. */
size_t fwrite(const void *data, size_t size, size_t n, FILE *file) {
    REAL(fwrite);
    if (size && n && kind != SHORT && watched(fileno(file))) {
        ssize_t may = allowed(size * n);
        if (kind == PART_ONCE && hits) kind = OFF; /* the C library has tried the rest, and met the error */
        return may < 0 ? 0 : real(data, size, may / size, file);
    }
    return real(data, size, n, file);
}

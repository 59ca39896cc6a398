/* LD_PRELOAD shim: what happens to files below CHAOS_DISK is written down, or fails as on a full or broken disk.
 *
 * CHAOS_TRACE: file that gets every operation, with its bytes, in order: header {kind, name length, offset, length},
 * name relative to CHAOS_DISK, bytes. CHAOS_FAULT: file of three int32 that is mapped: the error of operations that
 * write (0: none), how many still succeed, how many then fail. Failing writes first write half of what they should.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

enum { WRITE = 1, TRUNCATE, SYNC, UNLINK, RENAME, CREATE };
enum { FDS = 4096 };

static char *names[FDS]; /* relative to the disk, NULL for what is elsewhere */
static const char *disk;
static size_t disk_len;
static int trace_fd = -1;
static volatile int32_t *fault;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static ssize_t (*real_write)(int, const void *, size_t);
static ssize_t (*real_pwrite)(int, const void *, size_t, off_t);
static int (*real_open)(const char *, int, ...);

#define REAL(name) dlsym(RTLD_NEXT, name)

/* Also called by the constructors of other libraries that come first. */
__attribute__((constructor)) static void begin(void) {
    if (real_write) return;
    real_write = REAL("write"), real_pwrite = REAL("pwrite64"), real_open = REAL("open64");
    const char *trace = getenv("CHAOS_TRACE"), *control = getenv("CHAOS_FAULT");
    if (trace) trace_fd = real_open(trace, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    if (control) {
        int fd = real_open(control, O_RDWR | O_CLOEXEC);
        void *found = fd < 0 ? MAP_FAILED : mmap(NULL, 12, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
        if (found != MAP_FAILED) fault = found;
    }
    disk = getenv("CHAOS_DISK");
    disk_len = disk ? strlen(disk) : 0;
}

static const char *below(const char *path) {
    if (!disk || strncmp(path, disk, disk_len) || path[disk_len] != '/') return NULL;
    return path + disk_len + 1;
}

static const char *name_of(int fd) { return fd >= 0 && fd < FDS ? names[fd] : NULL; }

static void put(const void *bytes, size_t n) {
    while (n) {
        ssize_t done = real_write(trace_fd, bytes, n);
        if (done <= 0) abort();
        bytes = (const char *)bytes + done, n -= done;
    }
}

static void note(int kind, const char *name, int64_t offset, const void *bytes, size_t n) {
    if (trace_fd < 0) return;
    int saved = errno;
    int64_t header[4] = {kind, strlen(name), offset, (int64_t)n};
    pthread_mutex_lock(&lock);
    put(header, sizeof header), put(name, header[1]);
    if (bytes) put(bytes, n);
    pthread_mutex_unlock(&lock);
    errno = saved;
}

static int fails(void) {
    if (!fault || !fault[0]) return 0;
    int failed = 0;
    pthread_mutex_lock(&lock);
    if (fault[1] > 0) fault[1]--;
    else if (fault[2] > 0) fault[2]--, failed = 1;
    pthread_mutex_unlock(&lock);
    if (failed) errno = fault[0];
    return failed;
}

static int opened(int fd, const char *path, int flags, int existed) {
    const char *name = fd >= 0 && fd < FDS ? below(path) : NULL;
    if (!name) return fd;
    free(names[fd]);
    names[fd] = strdup(name);
    if ((flags & O_CREAT) && !existed) note(CREATE, name, 0, NULL, 0);
    if ((flags & O_TRUNC) && existed) note(TRUNCATE, name, 0, NULL, 0);
    return fd;
}

static int open_as(const char *path, int flags, mode_t mode) {
    begin();
    struct stat found;
    int existed = stat(path, &found) == 0;
    if ((flags & O_CREAT) && !existed && below(path) && fails()) return -1;
    return opened(real_open(path, flags, mode), path, flags, existed);
}

#define OPEN(name)                                                                                                     \
    int name(const char *path, int flags, ...) {                                                                       \
        va_list rest;                                                                                                  \
        va_start(rest, flags);                                                                                         \
        mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;                                                      \
        va_end(rest);                                                                                                  \
        return open_as(path, flags, mode);                                                                             \
    }
OPEN(open)
OPEN(open64)

int close(int fd) {
    static int (*real)(int);
    if (!real) real = REAL("close");
    if (name_of(fd)) free(names[fd]), names[fd] = NULL;
    return real(fd);
}

static ssize_t write_at(int fd, const void *bytes, size_t n, off_t offset) {
    const char *name = name_of(fd);
    if (fails()) {
        if (n > 1 && real_pwrite(fd, bytes, n / 2, offset) > 0) note(WRITE, name, offset, bytes, n / 2);
        return -1;
    }
    ssize_t done = real_pwrite(fd, bytes, n, offset);
    if (done > 0) note(WRITE, name, offset, bytes, done);
    return done;
}

ssize_t pwrite(int fd, const void *bytes, size_t n, off_t offset) {
    begin();
    return name_of(fd) ? write_at(fd, bytes, n, offset) : real_pwrite(fd, bytes, n, offset);
}

ssize_t pwrite64(int fd, const void *bytes, size_t n, off64_t offset) { return pwrite(fd, bytes, n, offset); }

ssize_t write(int fd, const void *bytes, size_t n) {
    begin();
    if (!name_of(fd)) return real_write(fd, bytes, n);
    int append = fcntl(fd, F_GETFL) & O_APPEND;
    off_t offset = lseek(fd, 0, append ? SEEK_END : SEEK_CUR);
    if (fails()) return -1;
    ssize_t done = real_write(fd, bytes, n);
    if (done > 0) note(WRITE, name_of(fd), offset, bytes, done);
    return done;
}

int ftruncate(int fd, off_t length) {
    static int (*real)(int, off_t);
    if (!real) real = REAL("ftruncate64");
    if (name_of(fd) && fails()) return -1;
    int result = real(fd, length);
    if (!result && name_of(fd)) note(TRUNCATE, name_of(fd), length, NULL, 0);
    return result;
}

int ftruncate64(int fd, off64_t length) { return ftruncate(fd, length); }

#define SYNC_AS(call)                                                                                                  \
    int call(int fd) {                                                                                                 \
        static int (*real)(int);                                                                                       \
        if (!real) real = REAL(#call);                                                                                 \
        if (name_of(fd) && fails()) return -1;                                                                         \
        int result = real(fd);                                                                                         \
        if (!result && name_of(fd)) note(SYNC, name_of(fd), 0, NULL, 0);                                               \
        return result;                                                                                                 \
    }
SYNC_AS(fsync)
SYNC_AS(fdatasync)

int unlink(const char *path) {
    static int (*real)(const char *);
    if (!real) real = REAL("unlink");
    int result = real(path);
    if (!result && below(path)) note(UNLINK, below(path), 0, NULL, 0);
    return result;
}

int rename(const char *from, const char *to) {
    static int (*real)(const char *, const char *);
    if (!real) real = REAL("rename");
    if (below(to) && fails()) return -1;
    int result = real(from, to);
    if (!result && below(from) && below(to)) note(RENAME, below(from), 0, below(to), strlen(below(to)));
    return result;
}

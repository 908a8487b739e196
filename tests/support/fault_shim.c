/* Loaded before the C library (LD_PRELOAD): writes below a folder fail from the n-th on, and the clocks are set.
 *
 * fault_disk(folder, n, code): every call that would write below the folder fails with the errno `code`, the n-th and
 *   all after it; 0 stops this. fault_writes() counts these calls. fault_clock(file): the first two doubles of the file
 *   are added to the wall clock and to the time since the start of the computer, s; they may change at any time.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static char folder[PATH_MAX];
static size_t folder_length;
static long first;
static int code;
static atomic_long writes;
static volatile double *offset;

void fault_disk(const char *path, long n, int error) {
  strncpy(folder, path, sizeof folder - 1);
  folder_length = strlen(folder);
  first = n;
  code = error;
  writes = 0;
}

long fault_writes(void) { return writes; }

int fault_clock(const char *path) {
  int file = REAL(open)(path, O_RDONLY);
  if (file < 0) return -1;
  void *found = mmap(NULL, 2 * sizeof(double), PROT_READ, MAP_SHARED, file, 0);
  close(file);
  if (found == MAP_FAILED) return -1;
  offset = found;
  return 0;
}

/* Whether a call that writes to this path fails; errno is set. */
static int fails(const char *path) {
  if (!folder_length || !path || strncmp(path, folder, folder_length)) return 0;
  long number = ++writes;
  if (!first || number < first) return 0;
  errno = code;
  return 1;
}

static int fails_at(int file) {
  if (!folder_length) return 0;
  char link[40], path[PATH_MAX];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return fails(path);
}

#define OPENING(name)                                                                 \
  int name(const char *path, int flags, ...) {                                        \
    va_list more;                                                                     \
    va_start(more, flags);                                                            \
    mode_t mode = va_arg(more, mode_t);                                               \
    va_end(more);                                                                     \
    if ((flags & O_CREAT) && fails(path)) return -1;                                  \
    return REAL(name)(path, flags, mode);                                             \
  }
OPENING(open)
OPENING(open64)

#define OPENING_AT(name)                                                              \
  int name(int place, const char *path, int flags, ...) {                             \
    va_list more;                                                                     \
    va_start(more, flags);                                                            \
    mode_t mode = va_arg(more, mode_t);                                               \
    va_end(more);                                                                     \
    if ((flags & O_CREAT) && fails(path)) return -1;                                  \
    return REAL(name)(place, path, flags, mode);                                      \
  }
OPENING_AT(openat)
OPENING_AT(openat64)

ssize_t write(int file, const void *data, size_t size) { return fails_at(file) ? -1 : REAL(write)(file, data, size); }
ssize_t pwrite(int file, const void *data, size_t size, off_t at) {
  return fails_at(file) ? -1 : REAL(pwrite)(file, data, size, at);
}
ssize_t pwrite64(int file, const void *data, size_t size, off64_t at) {
  return fails_at(file) ? -1 : REAL(pwrite64)(file, data, size, at);
}
ssize_t writev(int file, const struct iovec *parts, int count) {
  return fails_at(file) ? -1 : REAL(writev)(file, parts, count);
}
int ftruncate(int file, off_t size) { return size && fails_at(file) ? -1 : REAL(ftruncate)(file, size); }
int ftruncate64(int file, off64_t size) { return size && fails_at(file) ? -1 : REAL(ftruncate64)(file, size); }
int fsync(int file) { return fails_at(file) ? -1 : REAL(fsync)(file); }
int mkdir(const char *path, mode_t mode) { return fails(path) ? -1 : REAL(mkdir)(path, mode); }
int rename(const char *from, const char *to) { return fails(to) ? -1 : REAL(rename)(from, to); }

int clock_gettime(clockid_t which, struct timespec *now) {
  static __typeof__(&clock_gettime) real;
  if (!real) real = REAL(clock_gettime);
  int result = real(which, now);
  if (result || !offset || (which != CLOCK_REALTIME && which != CLOCK_BOOTTIME)) return result;
  double shift = offset[which == CLOCK_BOOTTIME], whole = floor(shift);
  now->tv_sec += (time_t)whole;
  now->tv_nsec += (long)((shift - whole) * 1e9);
  if (now->tv_nsec >= 1000000000L) now->tv_sec++, now->tv_nsec -= 1000000000L;
  return 0;
}

int gettimeofday(struct timeval *now, void *zone) {
  struct timespec fine;
  (void)zone;
  clock_gettime(CLOCK_REALTIME, &fine);
  now->tv_sec = fine.tv_sec;
  now->tv_usec = fine.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *out) {
  struct timespec fine;
  clock_gettime(CLOCK_REALTIME, &fine);
  if (out) *out = fine.tv_sec;
  return fine.tv_sec;
}

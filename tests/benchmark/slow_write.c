/* A disk that stands still: every write to a recording takes as long as SLOW_WRITE_S says. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

ssize_t write(int descriptor, const void *data, size_t size)
{
    static ssize_t (*next)(int, const void *, size_t);
    if (!next)
        next = dlsym(RTLD_NEXT, "write");
    const char *seconds = getenv("SLOW_WRITE_S");
    char name[64], path[4096];
    snprintf(name, sizeof name, "/proc/self/fd/%d", descriptor);
    ssize_t length = readlink(name, path, sizeof path);
    if (seconds && length > 5 && !memcmp(path + length - 5, ".mcap", 5)) {
        double left_s = atof(seconds);
        struct timespec left = {(time_t)left_s, (long)((left_s - (time_t)left_s) * 1e9)};
        while (nanosleep(&left, &left))
            ;
    }
    return next(descriptor, data, size);
}

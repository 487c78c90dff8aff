/* Lets a terminal answer the two requests by which hidapi tells a HID device from another file. All else is real. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <linux/hidraw.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ioctl.h>

int ioctl(int file, unsigned long request, ...) {
    va_list rest;
    va_start(rest, request);
    void *out = va_arg(rest, void *);
    va_end(rest);
    if (request == HIDIOCGRDESCSIZE) {
        *(int *)out = 1;
        return 0;
    }
    if (request == HIDIOCGRDESC) {
        memset(((struct hidraw_report_descriptor *)out)->value, 0, 1);
        return 0;
    }
    int (*real)(int, unsigned long, void *) = dlsym(RTLD_NEXT, "ioctl");
    return real(file, request, out);
}

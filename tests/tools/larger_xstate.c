/* Preloaded for a test: a processor with AMX, as far as ptrace() shows one. The area of PTRACE_GETREGSET and
 * PTRACE_SETREGSET is 8 KiB longer than it is, and the first SETREGSET that brings less is answered with EFAULT. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <string.h>
#include <sys/uio.h>

enum { GETREGSET = 0x4204, SETREGSET = 0x4205, X86_XSTATE = 0x202, MORE = 8192 };

typedef long ptrace_function(long request, long pid, void *addr, void *data);

static char area[65536];
static ptrace_function *next;

__attribute__((constructor)) static void find_next(void) { next = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace"); }

static size_t minimum(size_t a, size_t b) { return a < b ? a : b; }

long ptrace(long request, long pid, void *addr, void *data) {
    int which = (int)request;
    struct iovec *given = data, real = {area, sizeof area - MORE};
    long result;

    if ((which != GETREGSET && which != SETREGSET) || (long)addr != X86_XSTATE)
        return next(request, pid, addr, data);
    result = next(GETREGSET, pid, addr, &real);
    if (result < 0)
        return result;
    if (which == GETREGSET) {
        memset(area + real.iov_len, 0, MORE);
        given->iov_len = minimum(given->iov_len, real.iov_len + MORE);
        memcpy(given->iov_base, area, given->iov_len);
        return result;
    }
    if (given->iov_len < real.iov_len + MORE) {
        errno = EFAULT;
        return -1;
    }
    memcpy(area, given->iov_base, real.iov_len);
    return next(SETREGSET, pid, addr, &real);
}

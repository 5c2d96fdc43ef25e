/* Preloaded into User-mode Linux: ptrace() for a processor with a larger XSAVE area than the kernel program expects.
 *
 * linux.uml 6.1 and 6.12 store 2696 bytes of a process's floating-point state. PTRACE_SETREGSET accepts only the whole
 * area, otherwise it returns EFAULT, and with AMX the area has 11008 bytes: linux.uml panics at its first process. This
 * function reads the whole area, and returns or replaces the part that the caller requested, its beginning. If 2696
 * bytes are enough, it changes nothing.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <string.h>
#include <sys/uio.h>

enum { GETREGSET = 0x4204, SETREGSET = 0x4205, X86_XSTATE = 0x202 }; /* linux/ptrace.h, linux/elf.h */

typedef long ptrace_function(long request, long pid, void *addr, void *data);

/* Not on the stack: that of linux.uml has 16 kB. Not shared either: linux.uml has one CPU and one thread that traces. */
static char area[65536];
static ptrace_function *next;

__attribute__((constructor)) static void find_next(void) { next = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace"); }

/* sys/ptrace.h declares it with "...", which passes the same registers; so it is not included. */
long ptrace(long request, long pid, void *addr, void *data) {
    int which = (int)request;
    struct iovec *given = data, whole = {area, sizeof area};
    long result;

    if ((which != GETREGSET && which != SETREGSET) || (long)addr != X86_XSTATE)
        return next(request, pid, addr, data);
    result = next(GETREGSET, pid, addr, &whole);
    if (result < 0)
        return result;
    if (given->iov_len > whole.iov_len)
        return next(request, pid, addr, data);
    if (which == GETREGSET) {
        memcpy(given->iov_base, area, given->iov_len);
        return result;
    }
    memcpy(area, given->iov_base, given->iov_len);
    return next(SETREGSET, pid, addr, &whole);
}

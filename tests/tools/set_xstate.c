/* Sets the first 576 bytes of a stopped child's floating-point state, as linux.uml sets 2696 of a larger one. Prints
 * what PTRACE_SETREGSET answered, whether these bytes arrived, and whether the rest is as it was. */
#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>
#include <sys/wait.h>
#include <unistd.h>

enum { X86_XSTATE = 0x202, FIRST = 576, MXCSR = 24, ROUND_UP = 0x40 };

static unsigned char before[65536], after[65536];

static size_t get(pid_t child, unsigned char *area) {
    struct iovec all = {area, sizeof before};
    return ptrace(PTRACE_GETREGSET, child, (void *)X86_XSTATE, &all) ? 0 : all.iov_len;
}

int main(void) {
    pid_t child = fork();
    if (child == 0) {
        ptrace(PTRACE_TRACEME, 0, 0, 0);
        raise(SIGSTOP);
        _exit(0);
    }
    waitpid(child, 0, 0);
    size_t size = get(child, before);
    before[MXCSR + 1] ^= ROUND_UP;
    struct iovec beginning = {before, FIRST};
    long result = ptrace(PTRACE_SETREGSET, child, (void *)X86_XSTATE, &beginning);
    const char *answer = result == 0 ? "set" : errno == EFAULT ? "EFAULT" : "another error";
    size_t again = get(child, after);
    printf("%s, %s, %s, %s\n", size > FIRST ? "larger" : "not larger", answer,
           memcmp(before, after, FIRST) ? "not arrived" : "arrived",
           again == size && !memcmp(before + FIRST, after + FIRST, size - FIRST) ? "the rest as it was" : "the rest changed");
    kill(child, SIGKILL);
    return 0;
}

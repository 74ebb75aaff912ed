/* Lets a kernel whose buffer for the extended processor state is short (User-Mode Linux before 6.13: 2696 bytes) run
 * on a processor whose state is longer (AMX: about 11 kB). There the host answers PTRACE_SETREGSET of
 * NT_X86_XSTATE with EFAULT, because it takes only a whole buffer, while PTRACE_GETREGSET gives a prefix gladly.
 *
 * Preloaded, ptrace() completes such a write: it reads the thread's whole state, lays the caller's prefix over it
 * and writes the whole. XSTATE_BV (the mask of components that are not in their initial state, first word of the
 * XSAVE header) then comes from two places: for components inside the prefix from the caller, for those that reach
 * beyond it from the thread, whose bytes stay as they are. Source of the layout: Intel SDM volume 1, chapter 13.
 */
#define _GNU_SOURCE
#include <cpuid.h>
#include <dlfcn.h>
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

#ifndef NT_X86_XSTATE
#define NT_X86_XSTATE 0x202
#endif

enum { HEADER = 512, HEADER_END = 576, COMPONENTS = 63 };

typedef long (*ptrace_function)(enum __ptrace_request, pid_t, void *, void *);

static ptrace_function next_ptrace;
static uint32_t component_end[COMPONENTS];

/* Static, not on the stack: the caller runs on kernel stacks of 16 kB. It traces from one thread only. */
static unsigned char whole[1 << 16] __attribute__((aligned(64)));

__attribute__((constructor)) static void prepare(void)
{
	*(void **)&next_ptrace = dlsym(RTLD_NEXT, "ptrace");
	for (unsigned i = 2; i < COMPONENTS; i++) {
		unsigned size, offset, flags, unused;

		if (__get_cpuid_count(0xd, i, &size, &offset, &flags, &unused) && size != 0 && !(flags & 1))
			component_end[i] = offset + size;
	}
}

static uint64_t components_beyond(size_t length)
{
	uint64_t mask = 0;

	for (unsigned i = 2; i < COMPONENTS; i++)
		if (component_end[i] > length)
			mask |= UINT64_C(1) << i;
	return mask;
}

static long set_xstate(pid_t pid, void *type, struct iovec *given)
{
	struct iovec full = { .iov_base = whole, .iov_len = sizeof whole };
	uint64_t theirs, ours, beyond;

	if (next_ptrace(PTRACE_GETREGSET, pid, type, &full) < 0)
		return -1;
	if (given->iov_len < HEADER_END || given->iov_len >= full.iov_len)
		return next_ptrace(PTRACE_SETREGSET, pid, type, given);

	memcpy(&ours, whole + HEADER, sizeof ours);
	memcpy(whole, given->iov_base, given->iov_len);
	memcpy(&theirs, whole + HEADER, sizeof theirs);
	beyond = components_beyond(given->iov_len);
	theirs = (theirs & ~beyond) | (ours & beyond);
	memcpy(whole + HEADER, &theirs, sizeof theirs);
	return next_ptrace(PTRACE_SETREGSET, pid, type, &full);
}

long ptrace(enum __ptrace_request request, ...)
{
	va_list arguments;
	pid_t pid;
	void *address, *data;

	va_start(arguments, request);
	pid = va_arg(arguments, pid_t);
	address = va_arg(arguments, void *);
	data = va_arg(arguments, void *);
	va_end(arguments);

	if (next_ptrace == NULL) {
		errno = ENOSYS;
		return -1;
	}
	if (request == PTRACE_SETREGSET && (uintptr_t)address == NT_X86_XSTATE && data != NULL)
		return set_xstate(pid, address, data);
	return next_ptrace(request, pid, address, data);
}

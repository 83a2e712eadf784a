/* What a process may do around the library: load it late, close it while its threads may be about, fork. Nothing may be
 * printed by the library itself. */
#define _DEFAULT_SOURCE
#include "nertca_vk.h"

#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>

#define NEED(condition) \
  do { if (!(condition)) { fprintf(stderr, "line %d: %s\n", __LINE__, #condition); exit(1); } } while (0)

int main(int argc, char **argv) {
  nertca_status (*create)(const char *, const nertca_log *, nertca_context **);
  nertca_status (*describe)(nertca_context *, char *, size_t, size_t *);
  nertca_status (*destroy)(nertca_context *);
  NEED(argc == 2);
  for (int round = 0; round < 3; round++) {
    nertca_context *context = NULL;
    size_t length;
    pid_t child;
    int outcome;
    void *library = dlopen(argv[1], RTLD_NOW | RTLD_LOCAL);
    NEED(library);
    *(void **)&create = dlsym(library, "nertca_context_create");
    *(void **)&describe = dlsym(library, "nertca_context_describe");
    *(void **)&destroy = dlsym(library, "nertca_context_destroy");
    NEED(create && describe && destroy);
    NEED(create("", NULL, &context) == NERTCA_OK);
    NEED(describe(context, NULL, 0, &length) == NERTCA_OK);
    child = fork();
    if (child == 0) {
      /* The parent's handles are errors here; nothing hangs. */
      _exit(describe(context, NULL, 0, &length) == NERTCA_ERROR_FORKED && destroy(context) == NERTCA_ERROR_FORKED ? 0 : 1);
    }
    NEED(child > 0 && waitpid(child, &outcome, 0) == child && WIFEXITED(outcome) && WEXITSTATUS(outcome) == 0);
    NEED(describe(context, NULL, 0, &length) == NERTCA_OK);
    NEED(destroy(context) == NERTCA_OK);
    NEED(dlclose(library) == 0);
  }
  return 0;
}

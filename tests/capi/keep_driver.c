/* Built into a program under a leak checker: keeps the driver named in KEEP_DRIVER loaded until the end, so that what it
 * leaks is reported under its name and not as an unknown module's. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>

__attribute__((constructor)) static void keep_driver(void) {
  const char *driver = getenv("KEEP_DRIVER");
  if (!driver || !dlopen(driver, RTLD_LAZY | RTLD_LOCAL | RTLD_NODELETE)) {
    fprintf(stderr, "KEEP_DRIVER: %s\n", driver ? dlerror() : "not set");
    exit(2);
  }
}

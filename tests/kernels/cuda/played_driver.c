// A driver that has no GPU: it takes the calls that kernels are loaded and started with, and tells what it was given.
// Built as libcuda.so.1 by test_nvrtc.py, so that cuda-core and cuda-bindings themselves make the calls.
#include <stdio.h>
#include <string.h>

static int nothing(void) { return 0; }

static int version(int* number) {
  *number = 13000;
  return 0;
}

static int load(void** library, const void* code, void* a, void* b, unsigned c, void* d, void* e, unsigned f) {
  printf("load %.3s\n", (const char*)code + 1);
  *library = (void*)0x55;
  return 0;
}

static int get_kernel(void** kernel, void* library, const char* name) {
  printf("kernel %s of %p\n", name, library);
  *kernel = (void*)0x77;
  return 0;
}

static int occupancy(int* blocks, void* kernel, int block, size_t shared) {
  printf("occupancy of %p in blocks of %d with %zu\n", kernel, block, shared);
  *blocks = 7;
  return 0;
}

static int launch(void* kernel, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                  unsigned shared, void* stream, void** arguments, void** extra) {
  printf("launch %p: %u %u %u blocks of %u %u %u, %u shared, on %p, with %lld and %.2f, %s\n", kernel, gx, gy, gz, bx,
         by, bz, shared, stream, *(long long*)arguments[0], *(double*)arguments[1], extra ? "extra" : "no more");
  fflush(stdout);
  return 0;
}

static int launch_together(void* kernel, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                           unsigned shared, void* stream, void** arguments) {
  printf("together, ");
  return launch(kernel, gx, gy, gz, bx, by, bz, shared, stream, arguments, 0);
}

static int find(const char* name, void** function, int version_wanted, unsigned long long flags, int* status);

static const struct {
  const char* name;
  void* function;
} functions[] = {
    {"cuDriverGetVersion", version},
    {"cuLibraryLoadData", load},
    {"cuLibraryGetKernel", get_kernel},
    {"cuOccupancyMaxActiveBlocksPerMultiprocessor", occupancy},
    {"cuLaunchKernel", launch},
    {"cuLaunchCooperativeKernel", launch_together},
    {"cuGetProcAddress", find},
};

static int find(const char* name, void** function, int version_wanted, unsigned long long flags, int* status) {
  *function = nothing;
  for (size_t i = 0; i < sizeof functions / sizeof functions[0]; ++i)
    if (!strcmp(name, functions[i].name)) *function = functions[i].function;
  if (status) *status = 0;
  return 0;
}

int cuGetProcAddress_v2(const char* name, void** function, int version_wanted, unsigned long long flags, int* status) {
  return find(name, function, version_wanted, flags, status);
}

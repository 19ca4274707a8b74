// Picks the kernels for the machine that the library runs on.
#include <cstring>

#include "correlation.h"

namespace edge {
namespace {

struct Candidate {
  const Kernels* kernels;
  bool runs_here;
};

int64_t RoundUp(int64_t value, int64_t step) { return (value + step - 1) / step * step; }

}  // namespace

size_t ScratchBytes(const Shape& shape) {
  const int64_t width = RoundUp(shape.width, kPaddedTo);
  const int64_t searched = shape.disparities < shape.width ? shape.disparities : shape.width;
  const int64_t words = shape.channels * (2 * width + RoundUp(searched, kPaddedTo));
  return static_cast<size_t>(RoundUp(words * 4, static_cast<int64_t>(kScratchAlignment)));
}

const Kernels* SelectKernels(const char* name_or_null) {
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw");
  const bool vnni = avx512 && __builtin_cpu_supports("avx512vnni");
  const Candidate candidates[] = {{&kVnniKernels, vnni},
                                  {&kAvx512Kernels, avx512},
                                  {&kAvx2Kernels, avx2},
                                  {&kScalarKernels, true}};
#elif defined(__aarch64__)
  const Candidate candidates[] = {{&kNeonKernels, true}, {&kScalarKernels, true}};
#else
  const Candidate candidates[] = {{&kScalarKernels, true}};
#endif
  for (const Candidate& candidate : candidates) {
    if (!candidate.runs_here) continue;
    if (name_or_null == nullptr || std::strcmp(name_or_null, candidate.kernels->name) == 0) {
      return candidate.kernels;
    }
  }
  return nullptr;
}

}  // namespace edge

// The correlation kernels, one table of functions an instruction set.
//
//   volume[b, d, y, x] = mean over c of left[b, c, y, x] * right[b, c, y, x - d], and 0 where x < d
//
// All tensors are dense, [batch, channels, height, width] and [batch, disparities, height, width].
// Rows are counted through the batch: row = b * height + y. A call computes rows [first, last), so
// that callers can spread rows over threads; each thread brings its own scratch memory.
#ifndef EDGE_STEREO_CORRELATION_H_
#define EDGE_STEREO_CORRELATION_H_

#include <cstddef>
#include <cstdint>

#define EDGE_EXPORT extern "C" __attribute__((visibility("default")))

namespace edge {

// Environment variable: the name of an instruction set, to run less than the machine can.
constexpr char kInstructionSet[] = "EDGE_NATIVE_ISA";

struct Shape {
  int64_t batch;
  int64_t channels;
  int64_t height;
  int64_t width;
  int64_t disparities;
};

// An 8-bit tensor: uint8, or int8 where is_signed.
struct QuantizedView {
  const void* data;
  int32_t zero_point;
  bool is_signed;
};

struct QuantizedOutput {
  void* data;
  int32_t zero_point;
  bool is_signed;
  // float32(float64(left scale) * float64(right scale) / (channels * float64(output scale))).
  float multiplier;
};

using FloatRows = void (*)(const float* left, const float* right, float* volume, const Shape& shape,
                           int64_t first, int64_t last, void* scratch);
using QuantizedRows = void (*)(const QuantizedView& left, const QuantizedView& right,
                               const QuantizedOutput& volume, const Shape& shape, int64_t first,
                               int64_t last, void* scratch);

struct Kernels {
  const char* name;
  FloatRows float_rows;
  QuantizedRows quantized_rows;
};

// Columns are padded to this many, whatever the vector width, so that no load leaves a row.
constexpr int64_t kPaddedTo = 16;
constexpr size_t kScratchAlignment = 64;

// More channels than this could overflow the int32 sums of the quantized kernels.
constexpr int64_t kMostQuantizedChannels = 2147483647 / (255 * 255);

// Bytes of scratch memory that a call needs; a multiple of kScratchAlignment.
size_t ScratchBytes(const Shape& shape);

extern const Kernels kScalarKernels;
extern const Kernels kAvx2Kernels;
extern const Kernels kAvx512Kernels;
extern const Kernels kVnniKernels;
extern const Kernels kNeonKernels;

// The fastest kernels that this machine runs, or those of the name given; null where the machine
// does not run them or no such name is known.
const Kernels* SelectKernels(const char* name_or_null);

}  // namespace edge

#endif  // EDGE_STEREO_CORRELATION_H_

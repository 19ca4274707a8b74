// Plain C++: runs anywhere.
#include <cmath>

#include "correlation_row.h"

namespace edge {
namespace {

struct ScalarFloat {
  using Sum = float;
  static constexpr int64_t kLanes = 1;
  static constexpr int kGroup = 8;
  static Sum Zero() { return 0.0f; }
  static float Load(const float* words) { return *words; }
  static Sum MultiplyAdd(float a, float b, Sum sum) { return sum + a * b; }
  static Sum Broadcast(float value) { return value; }
  static Sum Divide(Sum a, Sum b) { return a / b; }
  static void Store(Sum sum, float* out, int64_t) { *out = sum; }
};

struct ScalarQuantized {
  using Sum = int32_t;
  static constexpr int64_t kLanes = 1;
  static constexpr int kGroup = 8;
  static Sum Zero() { return 0; }
  static PairOfChannels Load(const PairOfChannels* words) { return *words; }
  static Sum MultiplyAdd(PairOfChannels a, PairOfChannels b, Sum sum) {
    return sum + a.value[0] * b.value[0] + a.value[1] * b.value[1];
  }
  static void StoreQuantized(Sum sum, const Requantization& to, uint8_t* out, int64_t) {
    float scaled = static_cast<float>(sum) * to.multiplier;
    scaled = scaled < to.lowest ? to.lowest : scaled;
    scaled = scaled > to.highest ? to.highest : scaled;
    *out = static_cast<uint8_t>(static_cast<int32_t>(std::nearbyint(scaled)) + to.zero_point);
  }
};

}  // namespace

const Kernels kScalarKernels = {"scalar", CorrelateFloatRows<ScalarFloat>,
                                CorrelateQuantizedRows<ScalarQuantized>};

}  // namespace edge

// NEON, which every 64-bit ARM has: four columns at a time.
#include <arm_neon.h>

#include "correlation_row.h"

namespace edge {
namespace {

struct NeonFloat {
  using Sum = float32x4_t;
  static constexpr int64_t kLanes = 4;
  static constexpr int kGroup = 24;
  static Sum Zero() { return vdupq_n_f32(0.0f); }
  static float32x4_t Load(const float* words) { return vld1q_f32(words); }
  static Sum MultiplyAdd(float32x4_t a, float32x4_t b, Sum sum) { return vfmaq_f32(sum, a, b); }
  static Sum Broadcast(float value) { return vdupq_n_f32(value); }
  static Sum Divide(Sum a, Sum b) { return vdivq_f32(a, b); }
  static void Store(Sum sum, float* out, int64_t count) {
    if (count == kLanes) {
      vst1q_f32(out, sum);
      return;
    }
    float lanes[kLanes];
    vst1q_f32(lanes, sum);
    for (int64_t i = 0; i < count; ++i) out[i] = lanes[i];
  }
};

struct NeonQuantized {
  using Sum = int32x4_t;
  static constexpr int64_t kLanes = 4;
  static constexpr int kGroup = 24;
  static Sum Zero() { return vdupq_n_s32(0); }
  static int16x8_t Load(const PairOfChannels* words) { return vld1q_s16(words->value); }
  static Sum MultiplyAdd(int16x8_t a, int16x8_t b, Sum sum) {
    const int32x4_t low = vmull_s16(vget_low_s16(a), vget_low_s16(b));
    const int32x4_t high = vmull_high_s16(a, b);
    return vaddq_s32(sum, vpaddq_s32(low, high));
  }
  static void StoreQuantized(Sum sum, const Requantization& to, uint8_t* out, int64_t count) {
    float32x4_t scaled = vmulq_n_f32(vcvtq_f32_s32(sum), to.multiplier);
    scaled = vmaxq_f32(scaled, vdupq_n_f32(to.lowest));
    scaled = vminq_f32(scaled, vdupq_n_f32(to.highest));
    const int32x4_t rounded = vcvtnq_s32_f32(scaled);  // to nearest even
    int32_t lanes[kLanes];
    vst1q_s32(lanes, vaddq_s32(rounded, vdupq_n_s32(to.zero_point)));
    for (int64_t i = 0; i < count; ++i) out[i] = static_cast<uint8_t>(lanes[i]);
  }
};

}  // namespace

const Kernels kNeonKernels = {"neon", CorrelateFloatRows<NeonFloat>,
                              CorrelateQuantizedRows<NeonQuantized>};

}  // namespace edge

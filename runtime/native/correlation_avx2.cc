// AVX2 with FMA: eight columns at a time.
#include <immintrin.h>

#include "correlation_row.h"

namespace edge {
namespace {

struct Avx2Float {
  using Sum = __m256;
  static constexpr int64_t kLanes = 8;
  static constexpr int kGroup = 12;
  static Sum Zero() { return _mm256_setzero_ps(); }
  static __m256 Load(const float* words) { return _mm256_loadu_ps(words); }
  static Sum MultiplyAdd(__m256 a, __m256 b, Sum sum) { return _mm256_fmadd_ps(a, b, sum); }
  static Sum Broadcast(float value) { return _mm256_set1_ps(value); }
  static Sum Divide(Sum a, Sum b) { return _mm256_div_ps(a, b); }
  static void Store(Sum sum, float* out, int64_t count) {
    if (count == kLanes) {
      _mm256_storeu_ps(out, sum);
      return;
    }
    alignas(32) float lanes[kLanes];
    _mm256_store_ps(lanes, sum);
    for (int64_t i = 0; i < count; ++i) out[i] = lanes[i];
  }
};

struct Avx2Quantized {
  using Sum = __m256i;
  static constexpr int64_t kLanes = 8;
  static constexpr int kGroup = 12;
  static Sum Zero() { return _mm256_setzero_si256(); }
  static __m256i Load(const PairOfChannels* words) {
    return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(words));
  }
  static Sum MultiplyAdd(__m256i a, __m256i b, Sum sum) {
    return _mm256_add_epi32(sum, _mm256_madd_epi16(a, b));
  }
  static void StoreQuantized(Sum sum, const Requantization& to, uint8_t* out, int64_t count) {
    __m256 scaled = _mm256_mul_ps(_mm256_cvtepi32_ps(sum), _mm256_set1_ps(to.multiplier));
    scaled = _mm256_max_ps(scaled, _mm256_set1_ps(to.lowest));
    scaled = _mm256_min_ps(scaled, _mm256_set1_ps(to.highest));
    const __m256i rounded = _mm256_cvtps_epi32(scaled);  // to nearest even, the default mode
    alignas(32) int32_t lanes[kLanes];
    _mm256_store_si256(reinterpret_cast<__m256i*>(lanes),
                       _mm256_add_epi32(rounded, _mm256_set1_epi32(to.zero_point)));
    for (int64_t i = 0; i < count; ++i) out[i] = static_cast<uint8_t>(lanes[i]);
  }
};

}  // namespace

const Kernels kAvx2Kernels = {"avx2", CorrelateFloatRows<Avx2Float>,
                              CorrelateQuantizedRows<Avx2Quantized>};

}  // namespace edge

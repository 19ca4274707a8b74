// AVX-512 (F and BW): sixteen columns at a time. Included once for plain AVX-512 and once for VNNI.
#ifndef EDGE_STEREO_VECTOR_AVX512_H_
#define EDGE_STEREO_VECTOR_AVX512_H_

// GCC 12 takes the deliberately undefined operands inside its own header for a mistake of ours.
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wuninitialized"
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#include <immintrin.h>
#pragma GCC diagnostic pop
#else
#include <immintrin.h>
#endif

#include "correlation_row.h"

namespace edge {
namespace {

inline __mmask16 FirstLanes(int64_t count) {
  return static_cast<__mmask16>((uint32_t{1} << count) - 1);
}

struct Avx512Float {
  using Sum = __m512;
  static constexpr int64_t kLanes = 16;
  static constexpr int kGroup = 24;
  static Sum Zero() { return _mm512_setzero_ps(); }
  static __m512 Load(const float* words) { return _mm512_loadu_ps(words); }
  static Sum MultiplyAdd(__m512 a, __m512 b, Sum sum) { return _mm512_fmadd_ps(a, b, sum); }
  static Sum Broadcast(float value) { return _mm512_set1_ps(value); }
  static Sum Divide(Sum a, Sum b) { return _mm512_div_ps(a, b); }
  static void Store(Sum sum, float* out, int64_t count) {
    _mm512_mask_storeu_ps(out, FirstLanes(count), sum);
  }
};

struct Avx512Quantized {
  using Sum = __m512i;
  static constexpr int64_t kLanes = 16;
  static constexpr int kGroup = 24;
  static Sum Zero() { return _mm512_setzero_si512(); }
  static __m512i Load(const PairOfChannels* words) { return _mm512_loadu_si512(words); }
  static Sum MultiplyAdd(__m512i a, __m512i b, Sum sum) {
#ifdef __AVX512VNNI__
    return _mm512_dpwssd_epi32(sum, a, b);
#else
    return _mm512_add_epi32(sum, _mm512_madd_epi16(a, b));
#endif
  }
  static void StoreQuantized(Sum sum, const Requantization& to, uint8_t* out, int64_t count) {
    __m512 scaled = _mm512_mul_ps(_mm512_cvtepi32_ps(sum), _mm512_set1_ps(to.multiplier));
    scaled = _mm512_max_ps(scaled, _mm512_set1_ps(to.lowest));
    scaled = _mm512_min_ps(scaled, _mm512_set1_ps(to.highest));
    const __m512i rounded = _mm512_cvtps_epi32(scaled);  // to nearest even, the default mode
    const __m512i shifted = _mm512_add_epi32(rounded, _mm512_set1_epi32(to.zero_point));
    _mm512_mask_cvtepi32_storeu_epi8(out, FirstLanes(count), shifted);
  }
};

}  // namespace
}  // namespace edge

#endif  // EDGE_STEREO_VECTOR_AVX512_H_

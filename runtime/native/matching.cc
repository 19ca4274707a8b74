// See matching.h. Plain loops: compilers make vectors of them on any machine, and wider ones than
// the least that x86 has were measured to bring nothing.
#include "matching.h"

#include <algorithm>

namespace edge {
namespace {

// Saturated differences of the samples of one row, times their weights. Loops over a whole row, one
// for each kind of work: compilers make vectors of those.
void Differences(const MatchSamples& s, int64_t row, float center, float* __restrict shares,
                 int32_t* __restrict places, float* __restrict out) {
  const float* __restrict columns = s.columns;
  const float* __restrict behind = s.behind_per_px + row * s.stride;
  const float* __restrict wanted = s.wanted + row * s.stride;
  const float* __restrict weight = s.weight + row * s.stride;
  const float* __restrict strip = s.strips + row * s.strip_width;
  const float least_nearer = center / s.focal_baseline;  // no surface before a metre
  const float last_place = static_cast<float>(s.strip_width) - 1.001f;
  const int64_t count = s.stride / kMatchLanes * kMatchLanes;
  for (int64_t i = 0; i < count; ++i) {
    float nearer = behind[i] * center + 1.0f;  // so much smaller is the disparity of the surface
    nearer = nearer > least_nearer ? nearer : least_nearer;
    float place = columns[i] - center / nearer;
    place = place > 0.0f ? place : 0.0f;  // also where it is not a number
    place = place < last_place ? place : last_place;
    places[i] = static_cast<int32_t>(place);
    shares[i] = place - static_cast<float>(places[i]);
  }
  for (int64_t i = 0; i < count; ++i) {
    const float here = strip[places[i]], next = strip[places[i] + 1];
    const float difference = here * (1.0f - shares[i]) + next * shares[i] - wanted[i];
    const float size = (difference < 0.0f ? -difference : difference) / s.saturation;
    out[i] = (size < 1.0f ? size : 1.0f) * weight[i];
  }
}

// Mean of the smallest `trusted` of `means`, which are put in another order.
double TrustedMean(float* means, int64_t count, int64_t trusted) {
  std::nth_element(means, means + trusted - 1, means + count);
  double sum = 0.0;
  for (int64_t i = 0; i < trusted; ++i) sum += means[i];
  return sum / static_cast<double>(trusted);
}

}  // namespace

void MatchCosts(const MatchSamples& s, const double* centers_px, int64_t count, double* costs,
                float* scratch, int32_t* places) {
  const int64_t patches = s.row_patch_count * s.column_patch_count;
  float* sums = scratch;
  float* means = sums + patches;
  float* shares = means + patches;
  float* differences = shares + s.stride;
  for (int64_t k = 0; k < count; ++k) {
    const float center = static_cast<float>(centers_px[k]);
    std::fill(sums, sums + patches, 0.0f);
    int64_t band = 0;
    for (int64_t r = 0; r < s.row_count; ++r) {
      while (band + 1 < s.row_patch_count && r >= s.row_starts[band + 1]) ++band;
      Differences(s, r, center, shares, places, differences);
      float* into = sums + band * s.column_patch_count;
      for (int64_t p = 0; p < s.column_patch_count; ++p) {
        const bool last = p + 1 == s.column_patch_count;
        const int64_t end = last ? s.column_count : s.column_starts[p + 1];
        float sum = 0.0f;
        for (int64_t c = s.column_starts[p]; c < end; ++c) sum += differences[c];
        into[p] += sum;
      }
    }
    int64_t full = 0;
    for (int64_t p = 0; p < patches; ++p) {
      if (s.patch_samples[p] > 0.0f) means[full++] = sums[p] / s.patch_samples[p];
    }
    costs[k] = TrustedMean(means, full, std::min(s.trusted, full));
  }
}

}  // namespace edge

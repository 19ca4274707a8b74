// How badly the samples of a box match in the right view, for several disparities of its centre.
// The oracle is NumPy: runtime/refinement/mismatch.py.
#ifndef EDGE_STEREO_MATCHING_H_
#define EDGE_STEREO_MATCHING_H_

#include <cstdint>

namespace edge {

// Rows of samples are padded to a multiple of this; what is padded has no weight.
constexpr int64_t kMatchLanes = 8;

// One box: R rows of C samples, each row padded to `stride`.
struct MatchSamples {
  int64_t row_count;
  int64_t column_count;
  int64_t stride;
  const float* columns;        // [stride] of the right view at no disparity
  const float* behind_per_px;  // [R, stride] behind the centre, in units of 1 / disparity
  const float* wanted;         // [R, stride] values of the left view
  const float* weight;         // [R, stride] 1, or 0 where a sample does not count
  const float* strips;         // [R, strip_width] the right view along each row of samples
  int64_t strip_width;         // at least 2
  float focal_baseline;        // pixels times metres
  float saturation;            // difference from which on a sample counts as not matching
  int64_t row_patch_count;
  int64_t column_patch_count;
  const int64_t* row_starts;     // [row patches] first row of each
  const int64_t* column_starts;  // [column patches] first column of each
  const float* patch_samples;    // [row patches, column patches] weights; 0: the patch is left out
  int64_t trusted;               // of the patches so many count, those that match best
};

// costs[k] = mean over the trusted patches of their mean saturated difference, where the centre has
// a disparity of centers_px[k]. `scratch` holds 2 * (patches + stride)
// numbers, `places` as many as a row is padded to.
void MatchCosts(const MatchSamples& samples, const double* centers_px, int64_t count, double* costs,
                float* scratch, int32_t* places);

}  // namespace edge

#endif  // EDGE_STEREO_MATCHING_H_

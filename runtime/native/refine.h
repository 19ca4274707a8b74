// Depths of a frame's boxes refined by its pixels: runtime/refinement/depth.py, which is the
// oracle, in one call. Names, steps and their order are those of that package; its constants are
// handed over.
#ifndef EDGE_STEREO_REFINE_H_
#define EDGE_STEREO_REFINE_H_

#include <cstdint>

namespace edge {

// What runtime/refinement calls by the same names.
struct RefineRules {
  double vehicle_margins[3], person_margins[3];  // sides, above, below
  double smallest_box_px[2];                     // width, height
  double body_shares[2], cabin_shares[2];        // length, width
  double belt_share;
  double occluder_score, nearer_by_m, same_object_iou, inset_share, least_seen_share;
  double vehicle_saturation, person_saturation;
  double trusted_share, least_patch_share;
  double range_px, range_share, prior_per_px2, prior_limit_px2, least_disparity_px;
  double no_match;
  double elsewhere_px, most_difference, most_shift_px;
  int64_t most_columns, most_rows, fewest;
  int64_t patch_rows, patch_columns;
  int64_t coarse_steps, fine_steps;
};

struct RefineFrame {
  const float* left;   // [height, width] normalised, from image row first_row on
  const float* right;  // the same of the right view
  int64_t height, width, first_row;
  int64_t image_height;
  int64_t box_count;
  const double* boxes;     // [N, 4] x1 y1 x2 y2, pixels of the left image
  const double* size_hwl;  // [N, 3] metres
  const double* yaw_rad;   // [N]
  const double* score;     // [N]
  const uint8_t* solid;    // [N] vehicles
  const int64_t* order;    // [N] rows from near to far
  double* centers;         // [N, 3] metres; written
  double* evidence;        // [N, 6] columns of runtime/refinement/evidence.py; written
  double focal_px, principal_column_px;
  double focal_baseline, offset_px;
  double shift_m[2];  // from the reference frame to the left camera's, x and y
};

void RefineDepths(const RefineFrame& frame, const RefineRules& rules);

}  // namespace edge

#endif  // EDGE_STEREO_REFINE_H_

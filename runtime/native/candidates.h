// Suppression and votes of a frame's candidate boxes: runtime/nms.py and runtime/voting.py, which
// are the oracles. Boxes come by falling score.
#ifndef EDGE_STEREO_CANDIDATES_H_
#define EDGE_STEREO_CANDIDATES_H_

#include <cstdint>

namespace edge {

struct SuppressionFrame {
  const double* boxes;   // [N, 4] x1 y1 x2 y2
  const int64_t* group;  // [N], or null: all boxes are rivals
  const double* depth;   // [N] metres, or null: boxes of two groups never are
  int64_t count;
  double iou, depth_share;
  uint8_t* alive;  // [N] 0 or 1; written
};

void Suppress(const SuppressionFrame& frame);

struct VotingFrame {
  const float* boxes;       // [N, 11] columns of runtime/boxcode.py
  const float* score;       // [N]
  const int64_t* class_id;  // [N]
  const int64_t* keep;      // [M] rows of those
  int64_t count, kept_count;
  double iou, least_score_share, near_depth_share, near_angle_rad;
  float* means;  // [M, 11]; written
};

void Vote(const VotingFrame& frame);

}  // namespace edge

#endif  // EDGE_STEREO_CANDIDATES_H_

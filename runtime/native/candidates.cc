// See candidates.h.
#include "candidates.h"

#include <algorithm>
#include <cmath>
#include <vector>

namespace edge {
namespace {

// Columns of runtime/boxcode.py.
constexpr int64_t kColumns = 11, kDepth = 6, kAlpha = 10;

struct Box {
  double left, top, right, bottom;

  double Area() const { return (right - left) * (bottom - top); }
};

// 0 where the union is empty or no number, as runtime/nms.py has it.
double Iou(const Box& one, double one_area, const Box& other, double other_area) {
  const double width = std::min(one.right, other.right) - std::max(one.left, other.left);
  const double height = std::min(one.bottom, other.bottom) - std::max(one.top, other.top);
  const double overlap = std::max(width, 0.0) * std::max(height, 0.0);
  const double together = one_area + other_area - overlap;
  return together > 0.0 ? overlap / together : 0.0;
}

Box BoxOf(const float* row) { return {row[0], row[1], row[2], row[3]}; }

// The turn from one angle to another, within half a turn.
double Turn(double from_rad, double to_rad) {
  return std::atan2(std::sin(to_rad - from_rad), std::cos(to_rad - from_rad));
}

void Mean(const VotingFrame& frame, const float* kept, const std::vector<int64_t>& voters,
          float* out) {
  double sums[kColumns] = {}, weights = 0.0, turns_rad = 0.0, facing = 0.0;
  for (const int64_t voter : voters) {
    const float* row = frame.boxes + voter * kColumns;
    const double score = frame.score[voter];
    const double weight = score * score;
    weights += weight;
    for (int64_t i = 0; i < kColumns; ++i) sums[i] += weight * static_cast<double>(row[i]);
    const double turn_rad = Turn(kept[kAlpha], row[kAlpha]);
    if (std::abs(turn_rad) < frame.near_angle_rad) {
      turns_rad += weight * turn_rad;
      facing += weight;
    }
  }
  for (int64_t i = 0; i < kColumns; ++i) out[i] = static_cast<float>(sums[i] / weights);
  out[kAlpha] = static_cast<float>(static_cast<double>(kept[kAlpha]) + turns_rad / facing);
}

}  // namespace

void Suppress(const SuppressionFrame& frame) {
  const int64_t count = frame.count;
  std::vector<Box> boxes(static_cast<size_t>(count));
  std::vector<double> areas(static_cast<size_t>(count));
  for (int64_t i = 0; i < count; ++i) {
    const double* row = frame.boxes + 4 * i;
    boxes[static_cast<size_t>(i)] = {row[0], row[1], row[2], row[3]};
    areas[static_cast<size_t>(i)] = boxes[static_cast<size_t>(i)].Area();
  }
  std::fill(frame.alive, frame.alive + count, uint8_t{1});
  for (int64_t i = 0; i < count; ++i) {
    if (!frame.alive[i]) continue;
    const Box& best = boxes[static_cast<size_t>(i)];
    const double area = areas[static_cast<size_t>(i)];
    for (int64_t j = i + 1; j < count; ++j) {
      if (!frame.alive[j]) continue;
      if (frame.group != nullptr && frame.group[j] != frame.group[i]) {
        if (frame.depth == nullptr) continue;
        const double apart = std::abs(frame.depth[j] - frame.depth[i]);
        if (!(apart < frame.depth_share * frame.depth[i])) continue;
      }
      const size_t other = static_cast<size_t>(j);
      if (Iou(best, area, boxes[other], areas[other]) > frame.iou) frame.alive[j] = 0;
    }
  }
}

void Vote(const VotingFrame& frame) {
  const float least_share = static_cast<float>(frame.least_score_share);
  std::vector<int64_t> voters;
  for (int64_t m = 0; m < frame.kept_count; ++m) {
    const int64_t keep = frame.keep[m];
    const float* kept = frame.boxes + keep * kColumns;
    const Box box = BoxOf(kept);
    const double area = box.Area(), depth = kept[kDepth];
    const float least = least_share * frame.score[keep];
    voters.clear();
    for (int64_t i = 0; i < frame.count && frame.score[i] >= least; ++i) {
      if (frame.class_id[i] != frame.class_id[keep]) continue;
      const float* row = frame.boxes + i * kColumns;
      if (!(std::abs(static_cast<double>(row[kDepth]) / depth - 1.0) < frame.near_depth_share)) {
        continue;
      }
      const Box other = BoxOf(row);
      if (Iou(box, area, other, other.Area()) > frame.iou) voters.push_back(i);
    }
    float* out = frame.means + m * kColumns;
    std::copy(kept, kept + kColumns, out);
    if (voters.size() >= 2) Mean(frame, kept, voters, out);
  }
}

}  // namespace edge

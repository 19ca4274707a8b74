// See refine.h.
#include "refine.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "matching.h"

namespace edge {
namespace {

constexpr double kNowhere = std::numeric_limits<double>::quiet_NaN();
constexpr double kTiny = 1e-9;
constexpr int64_t kEvidence = 6;

double Clip(double value, double low, double high) { return std::min(std::max(value, low), high); }

int64_t Padded(int64_t count) { return (count + kMatchLanes - 1) / kMatchLanes * kMatchLanes; }

// As np.linspace.
void Spread(double first, double last, int64_t count, std::vector<double>& out) {
  out.resize(static_cast<size_t>(count));
  const double step = (last - first) / static_cast<double>(count - 1);
  for (int64_t i = 0; i < count; ++i) {
    out[static_cast<size_t>(i)] = static_cast<double>(i) * step + first;
  }
  out.back() = last;
}

// Where `most` groups of `size` samples begin; fewer where there are fewer samples.
void GroupStarts(int64_t most, int64_t size, std::vector<int64_t>& starts) {
  starts.clear();
  for (int64_t i = 0; i < most; ++i) {
    const int64_t start = i * size / most;
    if (starts.empty() || starts.back() != start) starts.push_back(start);
  }
}

// An image between its pixels, with `beyond` around it.
class Lookup {
 public:
  Lookup(const float* pixels, int64_t height, int64_t width, float beyond)
      : pixels_(pixels), height_(height), width_(width), beyond_(beyond) {}

  float At(int64_t y, int64_t x) const {
    const bool inside = y >= 0 && y < height_ && x >= 0 && x < width_;
    return inside ? pixels_[y * width_ + x] : beyond_;
  }

  float Between(float row, float column) const {
    const float top = std::floor(row), left = std::floor(column);
    const int64_t y = static_cast<int64_t>(top), x = static_cast<int64_t>(left);
    const float down = row - top, across = column - left;
    const float upper = At(y, x) * (1.0f - across) + At(y, x + 1) * across;
    const float lower = At(y + 1, x) * (1.0f - across) + At(y + 1, x + 1) * across;
    return upper * (1.0f - down) + lower * down;
  }

  // Columns left .. left + count - 1 along a row.
  void Strip(float row, int64_t left, int64_t count, float* out) const {
    const float top = std::floor(row);
    const int64_t y = static_cast<int64_t>(top);
    const float down = row - top;
    const int64_t first = std::min(std::max<int64_t>(-left, 0), count);
    const int64_t last = std::max(std::min(width_ - left, count), first);
    std::fill(out, out + first, beyond_);
    std::fill(out + last, out + count, beyond_);
    if (y >= 0 && y + 1 < height_) {
      const float* upper = pixels_ + y * width_ + left;
      const float* lower = upper + width_;
      for (int64_t i = first; i < last; ++i) out[i] = upper[i] * (1.0f - down) + lower[i] * down;
      return;
    }
    for (int64_t i = first; i < last; ++i) {
      out[i] = At(y, left + i) * (1.0f - down) + At(y + 1, left + i) * down;
    }
  }

 private:
  const float* pixels_;
  int64_t height_, width_;
  float beyond_;
};

// One box after another; memory is kept between them.
class Refiner {
 public:
  Refiner(const RefineFrame& frame, const RefineRules& rules)
      : frame_(frame),
        rules_(rules),
        left_(frame.left, frame.height, frame.width, 0.0f),
        right_(frame.right, frame.height, frame.width, static_cast<float>(rules.no_match)) {}

  void Refine(int64_t box) {
    double* center = frame_.centers + 3 * box;
    if (!(center[2] > 0.0) || !Sample(box)) return;
    Hide(box);
    double* evidence = frame_.evidence + kEvidence * box;
    evidence[kEvidence - 1] = 1.0 - SeenShare();
    if (!Look(box)) return;
    const double move = BestMove();
    const double depth_m = frame_.focal_baseline / (start_px_ + move);
    Judge(move, evidence);
    const double farther = depth_m / center[2];
    center[0] = (center[0] + frame_.shift_m[0]) * farther - frame_.shift_m[0];
    center[1] = (center[1] + frame_.shift_m[1]) * farther - frame_.shift_m[1];
    center[2] = depth_m;
  }

 private:
  const double* Box(int64_t box) const { return frame_.boxes + 4 * box; }
  bool Solid(int64_t box) const { return frame_.solid[box] != 0; }

  // Columns, rows and the surface seen there; false where there is too little of it.
  bool Sample(int64_t box) {
    const double* corners = Box(box);
    const double* margins = Solid(box) ? rules_.vehicle_margins : rules_.person_margins;
    const double limit[2] = {static_cast<double>(frame_.width) - 1.0,
                             static_cast<double>(frame_.image_height) - 1.0};
    const int64_t most[2] = {rules_.most_columns, rules_.most_rows};
    std::vector<double>* places[2] = {&columns_, &rows_};
    for (int axis = 0; axis < 2; ++axis) {
      const double low = Clip(corners[axis], 0.0, limit[axis]);
      const double high = Clip(corners[axis + 2], 0.0, limit[axis]);
      const double extent = high - low;
      if (!(extent >= rules_.smallest_box_px[axis])) return false;
      const double first = low + extent * margins[axis];
      const double last = high - extent * margins[axis == 0 ? 0 : 2];
      const double wanted = Clip(std::nearbyint(last - first), static_cast<double>(rules_.fewest),
                                 static_cast<double>(most[axis]));
      Spread(first, last, static_cast<int64_t>(wanted), *places[axis]);
    }
    return Surface(box);
  }

  // Metres from the centre's depth to that of an upright side of the plan in a column; NaN: missed.
  double FacingSide(int64_t box, double column, const double shares[2]) const {
    const double* center = frame_.centers + 3 * box;
    const double* size = frame_.size_hwl + 3 * box;
    const double half[2] = {0.5 * (size[2] * shares[0]), 0.5 * (size[1] * shares[1])};
    const double cosine = std::cos(frame_.yaw_rad[box]), sine = std::sin(frame_.yaw_rad[box]);
    const double x = -(center[0] + frame_.shift_m[0]), z = -center[2];
    const double ray = (column - frame_.principal_column_px) / frame_.focal_px;
    const double origin[2] = {cosine * x - sine * z, sine * x + cosine * z};
    const double direction[2] = {cosine * ray - sine, sine * ray + cosine};
    double enter = -std::numeric_limits<double>::infinity(), leave = -enter;
    for (int axis = 0; axis < 2; ++axis) {
      const double one = (-half[axis] - origin[axis]) / direction[axis];
      const double other = (half[axis] - origin[axis]) / direction[axis];
      if (std::isnan(one) || std::isnan(other)) return kNowhere;
      enter = std::max(enter, std::min(one, other));
      leave = std::min(leave, std::max(one, other));
    }
    return leave >= enter ? enter - center[2] : kNowhere;
  }

  // Keeps the columns in which the surface is hit.
  bool Surface(int64_t box) {
    const double* corners = Box(box);
    body_.clear();
    cabin_.clear();
    size_t kept = 0;
    for (const double column : columns_) {
      const bool solid = Solid(box);
      const double body = solid ? FacingSide(box, column, rules_.body_shares) : 0.0;
      if (!std::isfinite(body)) continue;
      const double cabin = solid ? FacingSide(box, column, rules_.cabin_shares) : 0.0;
      body_.push_back(body);
      cabin_.push_back(std::isfinite(cabin) ? cabin : body);
      columns_[kept++] = column;
    }
    columns_.resize(kept);
    if (static_cast<int64_t>(kept) < rules_.fewest - 1) return false;
    above_belt_.clear();
    for (const double row : rows_) {
      above_belt_.push_back((row - corners[1]) / (corners[3] - corners[1]) < rules_.belt_share);
    }
    return true;
  }

  // seen_: which samples no nearer box lies over.
  void Hide(int64_t box) {
    const size_t rows = rows_.size(), columns = columns_.size();
    seen_.assign(rows * columns, 1.0f);
    if (!Solid(box)) return;
    const double* own = Box(box);
    const double depth_m = frame_.centers[3 * box + 2];
    for (int64_t other = 0; other < frame_.box_count; ++other) {
      if (!(frame_.score[other] >= rules_.occluder_score)) continue;
      if (!(frame_.centers[3 * other + 2] < depth_m - rules_.nearer_by_m)) continue;
      const double* over = Box(other);
      const double overlap = Overlap(own, over);
      if (!(overlap > 0.0) || overlap > rules_.same_object_iou) continue;
      const double across = rules_.inset_share * (over[2] - over[0]);
      const double down = rules_.inset_share * (over[3] - over[1]);
      for (size_t r = 0; r < rows; ++r) {
        if (rows_[r] < over[1] + down || rows_[r] > over[3] - down) continue;
        for (size_t c = 0; c < columns; ++c) {
          const bool hidden = columns_[c] >= over[0] + across && columns_[c] <= over[2] - across;
          if (hidden) seen_[r * columns + c] = 0.0f;
        }
      }
    }
    if (SeenShare() < rules_.least_seen_share) std::fill(seen_.begin(), seen_.end(), 1.0f);
  }

  double SeenShare() const {
    double sum = 0.0;
    for (const float value : seen_) sum += value;
    return sum / static_cast<double>(seen_.size());
  }

  static double Overlap(const double* one, const double* other) {
    const double width = std::min(one[2], other[2]) - std::max(one[0], other[0]);
    const double height = std::min(one[3], other[3]) - std::max(one[1], other[1]);
    const double common = std::max(width, 0.0) * std::max(height, 0.0);
    const double areas =
        (one[2] - one[0]) * (one[3] - one[1]) + (other[2] - other[0]) * (other[3] - other[1]);
    return areas - common > 0.0 ? common / (areas - common) : 0.0;
  }

  // Fills samples_; false where the box is so far that nothing is searched.
  bool Look(int64_t box) {
    const int64_t rows = static_cast<int64_t>(rows_.size());
    const int64_t columns = static_cast<int64_t>(columns_.size());
    const int64_t stride = Padded(columns);
    start_px_ = frame_.focal_baseline / frame_.centers[3 * box + 2];
    reach_px_ = std::min(rules_.range_px + rules_.range_share * start_px_,
                         start_px_ - rules_.least_disparity_px);
    if (!(reach_px_ > 0.0)) return false;
    behind_.assign(static_cast<size_t>(rows * stride), 0.0f);
    wanted_.assign(behind_.size(), 0.0f);
    weight_.assign(behind_.size(), 0.0f);
    double nearest = 0.0;
    for (int64_t r = 0; r < rows; ++r) {
      const std::vector<double>& side = above_belt_[r] ? cabin_ : body_;
      const float row = static_cast<float>(rows_[r] - static_cast<double>(frame_.first_row));
      for (int64_t c = 0; c < columns; ++c) {
        const double behind = side[c] / frame_.focal_baseline;
        nearest = std::min(nearest, behind);
        behind_[r * stride + c] = static_cast<float>(behind);
        wanted_[r * stride + c] = left_.Between(row, static_cast<float>(columns_[c]));
        weight_[r * stride + c] = seen_[r * columns + c];
      }
    }
    samples_.row_count = rows;
    samples_.column_count = columns;
    samples_.stride = stride;
    LayStrips(nearest, stride);
    Group(box, rows, columns);
    samples_.behind_per_px = behind_.data();
    samples_.wanted = wanted_.data();
    samples_.weight = weight_.data();
    samples_.focal_baseline = static_cast<float>(frame_.focal_baseline);
    samples_.saturation =
        static_cast<float>(Solid(box) ? rules_.vehicle_saturation : rules_.person_saturation);
    return true;
  }

  // The right view along each row of samples, as wide as the search may reach.
  void LayStrips(double nearest, int64_t stride) {
    const double farthest_px = start_px_ + 2.0 * reach_px_;  // the fine search may step beyond
    const double nearer =
        std::max(1.0 + nearest * farthest_px, farthest_px / frame_.focal_baseline);
    const double most_px = farthest_px / nearer;
    const auto [low, high] = std::minmax_element(columns_.begin(), columns_.end());
    const int64_t border = 2, width = frame_.width;
    const auto place = [&](double column) {
      const double inside = Clip(std::floor(column), -static_cast<double>(border),
                                 static_cast<double>(width + border - 1));
      return static_cast<int64_t>(inside);
    };
    const int64_t left = place(*low - frame_.offset_px - most_px - 1.0);
    const int64_t count = std::max<int64_t>(place(*high - frame_.offset_px + 2.0) - left + 1, 2);
    strips_.resize(static_cast<size_t>(count) * rows_.size());
    for (size_t r = 0; r < rows_.size(); ++r) {
      const float row = static_cast<float>(rows_[r] - static_cast<double>(frame_.first_row));
      right_.Strip(row, left, count, strips_.data() + static_cast<size_t>(count) * r);
    }
    shifted_.assign(static_cast<size_t>(stride), 0.0f);
    for (size_t c = 0; c < columns_.size(); ++c) {
      shifted_[c] = static_cast<float>(columns_[c] - frame_.offset_px - static_cast<double>(left));
    }
    samples_.columns = shifted_.data();
    samples_.strips = strips_.data();
    samples_.strip_width = count;
  }

  // Samples that are judged together.
  void Group(int64_t box, int64_t rows, int64_t columns) {
    GroupStarts(Solid(box) ? rules_.patch_rows : 1, rows, row_starts_);
    GroupStarts(Solid(box) ? rules_.patch_columns : 1, columns, column_starts_);
    const size_t across = column_starts_.size();
    patch_samples_.assign(row_starts_.size() * across, 0.0f);
    size_t band = 0;
    for (int64_t r = 0; r < rows; ++r) {
      while (band + 1 < row_starts_.size() && r >= row_starts_[band + 1]) ++band;
      size_t patch = 0;
      for (int64_t c = 0; c < columns; ++c) {
        while (patch + 1 < across && c >= column_starts_[patch + 1]) ++patch;
        patch_samples_[band * across + patch] += seen_[r * columns + c];
      }
    }
    const float fullest = *std::max_element(patch_samples_.begin(), patch_samples_.end());
    int64_t full = 0;
    for (float& count : patch_samples_) {
      if (count < static_cast<float>(rules_.least_patch_share) * fullest) count = 0.0f;
      full += count > 0.0f;
    }
    samples_.row_patch_count = static_cast<int64_t>(row_starts_.size());
    samples_.column_patch_count = static_cast<int64_t>(across);
    samples_.row_starts = row_starts_.data();
    samples_.column_starts = column_starts_.data();
    samples_.patch_samples = patch_samples_.data();
    const double trusted = std::nearbyint(rules_.trusted_share * static_cast<double>(full));
    samples_.trusted = std::max<int64_t>(1, static_cast<int64_t>(trusted));
    scratch_.resize(2 * (patch_samples_.size() + static_cast<size_t>(samples_.stride)));
    places_.resize(static_cast<size_t>(samples_.stride));
  }

  // Costs of moves of the centre's disparity, plain and with the prior; gives the lowest one's
  // place.
  size_t Costs() {
    centers_.resize(moves_.size());
    costs_.resize(moves_.size());
    plain_.resize(moves_.size());
    for (size_t i = 0; i < moves_.size(); ++i) centers_[i] = start_px_ + moves_[i];
    MatchCosts(samples_, centers_.data(), static_cast<int64_t>(moves_.size()), plain_.data(),
               scratch_.data(), places_.data());
    for (size_t i = 0; i < moves_.size(); ++i) {
      costs_[i] = plain_[i] +
                  rules_.prior_per_px2 * std::min(moves_[i] * moves_[i], rules_.prior_limit_px2);
    }
    return static_cast<size_t>(std::min_element(costs_.begin(), costs_.end()) - costs_.begin());
  }

  double BestMove() {
    Spread(-reach_px_, reach_px_, rules_.coarse_steps, moves_);
    const double step = moves_[1] - moves_[0], middle = moves_[Costs()];
    coarse_moves_ = moves_;
    coarse_costs_ = plain_;
    Spread(middle - step, middle + step, rules_.fine_steps, moves_);
    const size_t lowest = Costs();
    double move = moves_[lowest];
    if (lowest > 0 && lowest + 1 < moves_.size()) {
      const double before = costs_[lowest - 1], here = costs_[lowest], after = costs_[lowest + 1];
      move += 0.5 * (moves_[1] - moves_[0]) *
              ((before - after) / (before - 2.0 * here + after + kTiny));
    }
    return move;
  }

  // The cost of a move, between those that were tried.
  double CostAt(double move) const {
    const auto after = std::upper_bound(coarse_moves_.begin(), coarse_moves_.end(), move);
    if (after == coarse_moves_.begin()) return coarse_costs_.front();
    if (after == coarse_moves_.end()) return coarse_costs_.back();
    const size_t next = static_cast<size_t>(after - coarse_moves_.begin());
    const double share =
        (move - coarse_moves_[next - 1]) / (coarse_moves_[next] - coarse_moves_[next - 1]);
    return coarse_costs_[next - 1] + share * (coarse_costs_[next] - coarse_costs_[next - 1]);
  }

  // How far the match can be believed: all columns of the evidence but the last.
  void Judge(double move, double* evidence) const {
    const double cost = CostAt(move);
    double rival = std::numeric_limits<double>::infinity();
    for (size_t i = 0; i < coarse_moves_.size(); ++i) {
      if (std::fabs(coarse_moves_[i] - move) > rules_.elsewhere_px) {
        rival = std::min(rival, coarse_costs_[i]);
      }
    }
    if (std::isinf(rival)) rival = 1.0;
    evidence[0] = cost;
    evidence[1] = CostAt(0.0) - cost;
    evidence[2] = std::min(rival - cost, rules_.most_difference);
    evidence[3] =
        std::min(std::fabs(move), rules_.most_shift_px) / std::sqrt(std::max(start_px_, 1.0));
    evidence[4] =
        std::min(0.5 * (CostAt(move - 1.0) + CostAt(move + 1.0)) - cost, rules_.most_difference);
  }

  const RefineFrame& frame_;
  const RefineRules& rules_;
  const Lookup left_, right_;
  double start_px_ = 0.0, reach_px_ = 0.0;
  MatchSamples samples_ = {};
  std::vector<double> columns_, rows_, body_, cabin_, moves_, centers_, costs_, plain_;
  std::vector<double> coarse_moves_, coarse_costs_;
  std::vector<char> above_belt_;
  std::vector<float> seen_, behind_, wanted_, weight_, strips_, shifted_, patch_samples_, scratch_;
  std::vector<int64_t> row_starts_, column_starts_;
  std::vector<int32_t> places_;
};

}  // namespace

void RefineDepths(const RefineFrame& frame, const RefineRules& rules) {
  Refiner refiner(frame, rules);
  for (int64_t i = 0; i < frame.box_count; ++i) refiner.Refine(frame.order[i]);
}

}  // namespace edge

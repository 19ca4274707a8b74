// Runs every kernel that this machine has over awkward sizes, on buffers of exactly the needed
// size, so that the address and undefined-behaviour sanitizers see any step beside them; compares
// with plain loops.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <random>
#include <vector>

#include "candidates.h"
#include "correlation.h"
#include "refine.h"

namespace {

using edge::Kernels;
using edge::QuantizedOutput;
using edge::QuantizedView;
using edge::Shape;

constexpr float kFloatTolerance = 2e-6f;
constexpr int64_t kRowsAtOnce = 2;

const Shape kShapes[] = {
    {1, 1, 1, 1, 1},     // the least
    {1, 1, 2, 1, 5},     // one column
    {2, 1, 3, 5, 7},     // W < D
    {1, 13, 2, 7, 7},    // W = D
    {1, 13, 2, 16, 24},  // one vector of columns, W < D
    {3, 13, 5, 37, 24},  // W no multiple of any vector
    {2, 64, 3, 33, 47},  // D no multiple of any tile
    {1, 2, 1, 130, 13},
};

int64_t Left(const Shape& s, int64_t b, int64_t c, int64_t y, int64_t x) {
  return ((b * s.channels + c) * s.height + y) * s.width + x;
}

// Calls visit(index in volume, sum over channels of term(left index, right index)).
template <class Sum, class Term, class Visit>
void ForVolume(const Shape& s, const Term& term, const Visit& visit) {
  int64_t index = 0;
  for (int64_t b = 0; b < s.batch; ++b)
    for (int64_t d = 0; d < s.disparities; ++d)
      for (int64_t y = 0; y < s.height; ++y)
        for (int64_t x = 0; x < s.width; ++x, ++index) {
          Sum sum = 0;
          for (int64_t c = 0; x >= d && c < s.channels; ++c) {
            sum += term(Left(s, b, c, y, x), Left(s, b, c, y, x - d));
          }
          visit(index, sum);
        }
}

template <class Rows>
void InPieces(const Shape& s, const Rows& rows) {
  for (int64_t row = 0; row < s.batch * s.height; row += kRowsAtOnce) {
    const int64_t end = std::min(row + kRowsAtOnce, s.batch * s.height);
    void* scratch = std::aligned_alloc(edge::kScratchAlignment, edge::ScratchBytes(s));
    rows(row, end, scratch);
    std::free(scratch);
  }
}

int CheckFloat(const Kernels& kernels, const Shape& s, std::mt19937& random) {
  const size_t inputs = static_cast<size_t>(s.batch * s.channels * s.height * s.width);
  std::vector<float> left(inputs), right(inputs);
  std::normal_distribution<float> normal;
  for (float& value : left) value = normal(random);
  for (float& value : right) value = normal(random);
  std::vector<float> volume(static_cast<size_t>(s.batch * s.disparities * s.height * s.width),
                            std::numeric_limits<float>::quiet_NaN());
  InPieces(s, [&](int64_t first, int64_t last, void* scratch) {
    kernels.float_rows(left.data(), right.data(), volume.data(), s, first, last, scratch);
  });
  int wrong = 0;
  ForVolume<double>(
      s, [&](int64_t l, int64_t r) { return static_cast<double>(left[l]) * right[r]; },
      [&](int64_t index, double sum) {
        const double expected = sum / static_cast<double>(s.channels);
        wrong += !(std::fabs(volume[index] - expected) <= kFloatTolerance);
      });
  return wrong;
}

template <class Byte>
int CheckQuantized(const Kernels& kernels, const Shape& s, std::mt19937& random) {
  using Limits = std::numeric_limits<Byte>;
  const size_t inputs = static_cast<size_t>(s.batch * s.channels * s.height * s.width);
  std::vector<Byte> left(inputs), right(inputs);
  std::uniform_int_distribution<int> bytes(Limits::min(), Limits::max());
  for (Byte& value : left) value = static_cast<Byte>(bytes(random));
  for (Byte& value : right) value = static_cast<Byte>(bytes(random));
  std::vector<Byte> volume(static_cast<size_t>(s.batch * s.disparities * s.height * s.width));
  const bool is_signed = Limits::is_signed;
  const int zero_left = bytes(random), zero_right = bytes(random), zero_out = bytes(random);
  const float multiplier = 0.013f / static_cast<float>(s.channels);
  const QuantizedView left_view = {left.data(), zero_left, is_signed};
  const QuantizedView right_view = {right.data(), zero_right, is_signed};
  const QuantizedOutput out = {volume.data(), zero_out, is_signed, multiplier};
  InPieces(s, [&](int64_t first, int64_t last, void* scratch) {
    kernels.quantized_rows(left_view, right_view, out, s, first, last, scratch);
  });
  int wrong = 0;
  ForVolume<int32_t>(
      s, [&](int64_t l, int64_t r) { return (left[l] - zero_left) * (right[r] - zero_right); },
      [&](int64_t index, int32_t sum) {
        const float rounded = std::nearbyint(static_cast<float>(sum) * multiplier);
        const float value = rounded + static_cast<float>(zero_out);
        const float low = Limits::min(), high = Limits::max();
        wrong += volume[index] != static_cast<Byte>(std::min(std::max(value, low), high));
      });
  return wrong;
}

// Boxes anywhere, also outside the image and of no size, in images of exactly the needed size.
int CheckRefine(std::mt19937& random) {
  const edge::RefineRules rules = {{0.06, 0.15, 0.12},
                                   {0.25, 0.08, 0.12},
                                   {6.0, 8.0},
                                   {0.92, 0.92},
                                   {0.7, 0.85},
                                   0.42,
                                   0.5,
                                   0.5,
                                   0.5,
                                   0.05,
                                   0.25,
                                   0.7,
                                   1.0,
                                   0.8,
                                   0.3,
                                   4.0,
                                   0.06,
                                   0.02,
                                   2.0,
                                   2.0,
                                   1e3,
                                   1.5,
                                   0.3,
                                   6.0,
                                   28,
                                   24,
                                   4,
                                   3,
                                   8,
                                   33,
                                   9};
  const int64_t height = 70, width = 121, first_row = 5, boxes = 200;
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::vector<float> left(height * width), right(height * width);
  for (float& value : left) value = static_cast<float>(uniform(random));
  for (float& value : right) value = static_cast<float>(uniform(random));
  std::vector<double> corners, size, yaw, score, centers;
  std::vector<uint8_t> solid;
  std::vector<int64_t> order;
  for (int64_t i = 0; i < boxes; ++i) {
    const double x = 160.0 * uniform(random) - 20.0, y = 90.0 * uniform(random) - 10.0;
    const double bottom = std::min(y + 80.0 * uniform(random), static_cast<double>(height + 4));
    corners.insert(corners.end(), {x, y, x + 90.0 * uniform(random), bottom});
    size.insert(size.end(), {1.5, 1.6, 4.0 * uniform(random)});
    yaw.push_back(6.0 * uniform(random));
    score.push_back(uniform(random));
    solid.push_back(uniform(random) < 0.7);
    order.push_back(i);
    centers.insert(centers.end(), {4.0 * uniform(random) - 2.0, 0.0, 60.0 * uniform(random)});
  }
  const std::vector<double> before = centers;
  std::vector<double> evidence(6 * boxes);
  const edge::RefineFrame frame = {
      left.data(),  right.data(),   height,          width,      first_row,    height + first_row,
      boxes,        corners.data(), size.data(),     yaw.data(), score.data(), solid.data(),
      order.data(), centers.data(), evidence.data(), 100.0,      60.0,         50.0,
      0.5,          {0.05, 0.0}};
  edge::RefineDepths(frame, rules);
  int wrong = centers == before;  // some must have moved
  for (const double value : centers) wrong += !std::isfinite(value);
  for (const double value : evidence) wrong += !std::isfinite(value);
  return wrong;
}

// Boxes on a few spots, also of no size, of several classes and depths.
int CheckCandidates(std::mt19937& random) {
  const int64_t count = 300, columns = 11;
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::vector<float> boxes, score;
  std::vector<double> corners, depth;
  std::vector<int64_t> class_id, keep;
  for (int64_t i = 0; i < count; ++i) {
    const double x = 20.0 * std::floor(4.0 * uniform(random)), y = 3.0 * uniform(random);
    const double width = i % 7 == 0 ? 0.0 : 10.0 + 3.0 * uniform(random);
    const double z = 10.0 + 10.0 * uniform(random);
    corners.insert(corners.end(), {x, y, x + width, y + 12.0});
    depth.push_back(z);
    for (int64_t column = 0; column < columns; ++column) {
      const double value = column < 4    ? corners[static_cast<size_t>(4 * i + column)]
                           : column == 6 ? z
                                         : uniform(random);
      boxes.push_back(static_cast<float>(value));
    }
    score.push_back(1.0f - 0.9f * static_cast<float>(i) / count);
    class_id.push_back(static_cast<int64_t>(3.0 * uniform(random)));
  }
  int wrong = 0;
  int64_t before = 0;
  for (const bool grouped : {false, true}) {
    std::vector<uint8_t> alive(count);
    edge::Suppress({corners.data(), grouped ? class_id.data() : nullptr,
                    grouped ? depth.data() : nullptr, count, 0.4, 0.15, alive.data()});
    keep.clear();
    for (int64_t i = 0; i < count; ++i) {
      if (alive[static_cast<size_t>(i)]) keep.push_back(i);
    }
    const int64_t kept = static_cast<int64_t>(keep.size());
    wrong += kept <= before || kept == count;  // fewer are rivals by group
    before = kept;
  }
  std::vector<float> means(keep.size() * columns);
  edge::Vote({boxes.data(), score.data(), class_id.data(), keep.data(), count,
              static_cast<int64_t>(keep.size()), 0.7, 0.5, 0.15, 0.8, means.data()});
  int moved = 0;
  for (size_t m = 0; m < keep.size(); ++m) {
    for (int64_t column = 0; column < columns; ++column) {
      const float mean = means[m * columns + static_cast<size_t>(column)];
      wrong += !std::isfinite(mean);
      moved += mean != boxes[static_cast<size_t>(keep[m] * columns + column)];
    }
  }
  return wrong + (moved == 0);
}

}  // namespace

int main() {
  std::mt19937 random(1);
  int wrong = 0;
  for (const char* name : {"scalar", "avx2", "avx512", "vnni", "neon"}) {
    const Kernels* kernels = edge::SelectKernels(name);
    if (kernels == nullptr) {
      std::printf("%s: not on this machine\n", name);
      continue;
    }
    int here = 0;
    for (const Shape& shape : kShapes) {
      here += CheckFloat(*kernels, shape, random);
      here += CheckQuantized<uint8_t>(*kernels, shape, random);
      here += CheckQuantized<int8_t>(*kernels, shape, random);
    }
    std::printf("%s: %d wrong\n", name, here);
    wrong += here;
  }
  const int refined = CheckRefine(random);
  std::printf("refine: %d wrong\n", refined);
  wrong += refined;
  const int thinned = CheckCandidates(random);
  std::printf("candidates: %d wrong\n", thinned);
  wrong += thinned;
  if (edge::SelectKernels("mmx") != nullptr || edge::SelectKernels(nullptr) == nullptr) ++wrong;
  return wrong == 0 ? 0 : 1;
}

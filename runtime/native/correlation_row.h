// The kernel, written once for all instruction sets; each .cc brings its vector type.
//
// Per image row, both views are first packed: channels of one row side by side, the right view with
// zeros for the columns left of the image. That makes every load a plain one (columns x < d meet
// the zeros and give 0 by themselves), and keeps a row's data together, where the distance between
// the channels of an image, often a multiple of 2 KiB, would let them evict each other from the
// cache. A tile then holds one vector of columns for a group of disparities in registers over all
// channels: one load of the left view serves the whole group.
//
// A packed word has four bytes: a float, or the int16 differences (value - zero point) of two
// channels, whose products one instruction adds up. The same loops serve both.
//
// Everything here is in an unnamed namespace and calls nothing from outside: code compiled for one
// instruction set must not be merged by the linker with that of another.
#ifndef EDGE_STEREO_CORRELATION_ROW_H_
#define EDGE_STEREO_CORRELATION_ROW_H_

#include "correlation.h"

// The sums stay in registers only where the loop over them is unrolled.
#if defined(__clang__)
#define EDGE_UNROLL _Pragma("unroll")
#else
#define EDGE_UNROLL _Pragma("GCC unroll 32")
#endif

namespace edge {
namespace {

constexpr int64_t RoundUp(int64_t value, int64_t step) { return (value + step - 1) / step * step; }
constexpr int64_t Smaller(int64_t a, int64_t b) { return a < b ? a : b; }

// Where the packed rows lie; strides in words.
struct Packing {
  int64_t planes;        // channels, or pairs of channels
  int64_t left_stride;   // between the planes of the left row
  int64_t lead;          // zero columns before the right row
  int64_t right_stride;  // between the planes of the right row
  int64_t searched;      // disparities below the width; all others give 0
};

inline Packing MakePacking(const Shape& shape, int64_t planes) {
  Packing packing;
  packing.planes = planes;
  packing.left_stride = RoundUp(shape.width, kPaddedTo);
  packing.searched = Smaller(shape.disparities, shape.width);
  packing.lead = RoundUp(packing.searched - 1, kPaddedTo);
  packing.right_stride = packing.lead + packing.left_stride;
  return packing;
}

template <class Word>
void Clear(Word* words, int64_t count) {
  for (int64_t i = 0; i < count; ++i) words[i] = Word{};
}

// Sums a vector of columns for kGroup disparities from `disparity` on, over all planes.
template <class Vector, int kGroup, class Word, class Finish>
void Tile(const Word* left, const Word* right, const Packing& packing, int64_t disparity,
          const Finish& finish) {
  typename Vector::Sum sums[kGroup];
  EDGE_UNROLL
  for (int g = 0; g < kGroup; ++g) sums[g] = Vector::Zero();
  const Word* shifted = right - disparity;
  for (int64_t plane = 0; plane < packing.planes; ++plane) {
    const auto left_words = Vector::Load(left);
    EDGE_UNROLL
    for (int g = 0; g < kGroup; ++g) {
      sums[g] = Vector::MultiplyAdd(left_words, Vector::Load(shifted - g), sums[g]);
    }
    left += packing.left_stride;
    shifted += packing.right_stride;
  }
  EDGE_UNROLL
  for (int g = 0; g < kGroup; ++g) finish(sums[g], disparity + g);
}

// Tiles of kGroup disparities as long as they fit, then smaller ones; returns where it ended.
template <class Vector, int kGroup, class Word, class Finish>
int64_t Tiles(const Word* left, const Word* right, const Packing& packing, int64_t disparity,
              const Finish& finish) {
  while (disparity + kGroup <= packing.searched) {
    Tile<Vector, kGroup>(left, right, packing, disparity, finish);
    disparity += kGroup;
  }
  if constexpr (kGroup > 1) {
    disparity = Tiles<Vector, kGroup / 2>(left, right, packing, disparity, finish);
  }
  return disparity;
}

// finish(sums, x, count, disparity) stores `count` columns from x on.
template <class Vector, class Word, class Finish>
void CorrelatePackedRow(const Word* left, const Word* right, const Packing& packing, int64_t width,
                        const Finish& finish) {
  for (int64_t x = 0; x < width; x += Vector::kLanes) {
    const int64_t count = Smaller(Vector::kLanes, width - x);
    Tiles<Vector, Vector::kGroup>(
        left + x, right + packing.lead + x, packing, 0,
        [&](const typename Vector::Sum& sums, int64_t d) { finish(sums, x, count, d); });
  }
}

template <class Vector>
void CorrelateFloatRows(const float* left, const float* right, float* volume, const Shape& shape,
                        int64_t first, int64_t last, void* scratch) {
  const Packing packing = MakePacking(shape, shape.channels);
  float* left_row = static_cast<float*>(scratch);
  float* right_row = left_row + packing.planes * packing.left_stride;
  Clear(left_row, packing.planes * (packing.left_stride + packing.right_stride));
  const int64_t plane = shape.height * shape.width;
  const auto divisor = Vector::Broadcast(static_cast<float>(shape.channels));
  for (int64_t row = first; row < last; ++row) {
    const int64_t b = row / shape.height, y = row % shape.height;
    const int64_t start = b * shape.channels * plane + y * shape.width;
    for (int64_t c = 0; c < shape.channels; ++c) {
      const float* from_left = left + start + c * plane;
      const float* from_right = right + start + c * plane;
      float* to_left = left_row + c * packing.left_stride;
      float* to_right = right_row + c * packing.right_stride + packing.lead;
      for (int64_t x = 0; x < shape.width; ++x) to_left[x] = from_left[x];
      for (int64_t x = 0; x < shape.width; ++x) to_right[x] = from_right[x];
    }
    float* out = volume + b * shape.disparities * plane + y * shape.width;
    CorrelatePackedRow<Vector>(
        left_row, right_row, packing, shape.width,
        [&](const typename Vector::Sum& sums, int64_t x, int64_t count, int64_t d) {
          Vector::Store(Vector::Divide(sums, divisor), out + d * plane + x, count);
        });
    for (int64_t d = packing.searched; d < shape.disparities; ++d) {
      Clear(out + d * plane, shape.width);
    }
  }
}

// Two int16 in one word; the sum of two products of differences of 8-bit values fits int32.
struct PairOfChannels {
  int16_t value[2];
};

template <class Byte>
void PackPlane(const Byte* even, const Byte* odd_or_null, int32_t zero_point, int64_t width,
               PairOfChannels* words) {
  if (odd_or_null == nullptr) {
    for (int64_t x = 0; x < width; ++x) {
      words[x].value[0] = static_cast<int16_t>(even[x] - zero_point);
      words[x].value[1] = 0;
    }
    return;
  }
  for (int64_t x = 0; x < width; ++x) {
    words[x].value[0] = static_cast<int16_t>(even[x] - zero_point);
    words[x].value[1] = static_cast<int16_t>(odd_or_null[x] - zero_point);
  }
}

template <class Byte>
void PackRow(const Byte* start, int32_t zero_point, const Shape& shape, int64_t stride,
             PairOfChannels* words) {
  const int64_t plane = shape.height * shape.width;
  for (int64_t c = 0; c < shape.channels; c += 2) {
    const Byte* even = start + c * plane;
    const Byte* odd = c + 1 < shape.channels ? even + plane : nullptr;
    PackPlane(even, odd, zero_point, shape.width, words + c / 2 * stride);
  }
}

inline void PackQuantizedRow(const QuantizedView& view, int64_t start, const Shape& shape,
                             int64_t stride, PairOfChannels* words) {
  if (view.is_signed) {
    PackRow(static_cast<const int8_t*>(view.data) + start, view.zero_point, shape, stride, words);
  } else {
    PackRow(static_cast<const uint8_t*>(view.data) + start, view.zero_point, shape, stride, words);
  }
}

// out = saturate(round_half_even(float32(sum) * multiplier) + zero point): limits are taken off the
// zero point first, so that what is rounded always fits an int.
struct Requantization {
  float multiplier;
  float lowest;
  float highest;
  int32_t zero_point;
};

template <class Vector>
void CorrelateQuantizedRows(const QuantizedView& left, const QuantizedView& right,
                            const QuantizedOutput& volume, const Shape& shape, int64_t first,
                            int64_t last, void* scratch) {
  const Packing packing = MakePacking(shape, (shape.channels + 1) / 2);
  PairOfChannels* left_row = static_cast<PairOfChannels*>(scratch);
  PairOfChannels* right_row = left_row + packing.planes * packing.left_stride;
  Clear(left_row, packing.planes * (packing.left_stride + packing.right_stride));
  const int32_t lowest = volume.is_signed ? -128 : 0, highest = volume.is_signed ? 127 : 255;
  const Requantization requantization = {
      volume.multiplier, static_cast<float>(lowest - volume.zero_point),
      static_cast<float>(highest - volume.zero_point), volume.zero_point};
  const int64_t plane = shape.height * shape.width;
  for (int64_t row = first; row < last; ++row) {
    const int64_t b = row / shape.height, y = row % shape.height;
    const int64_t start = b * shape.channels * plane + y * shape.width;
    PackQuantizedRow(left, start, shape, packing.left_stride, left_row);
    PackQuantizedRow(right, start, shape, packing.right_stride, right_row + packing.lead);
    // Stored by their bits, which are the same for uint8 and int8.
    uint8_t* out =
        static_cast<uint8_t*>(volume.data) + b * shape.disparities * plane + y * shape.width;
    CorrelatePackedRow<Vector>(
        left_row, right_row, packing, shape.width,
        [&](const typename Vector::Sum& sums, int64_t x, int64_t count, int64_t d) {
          Vector::StoreQuantized(sums, requantization, out + d * plane + x, count);
        });
    for (int64_t d = packing.searched; d < shape.disparities; ++d) {
      for (int64_t x = 0; x < shape.width; ++x) {
        out[d * plane + x] = static_cast<uint8_t>(volume.zero_point);
      }
    }
  }
}

}  // namespace
}  // namespace edge

#endif  // EDGE_STEREO_CORRELATION_ROW_H_

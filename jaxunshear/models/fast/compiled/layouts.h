// The layouts of an image of pixels (rows, columns, channels) in memory: plain, padded by one pixel of zeros, or padded and folded
// in blocks of 2x2 pixels. Reading one layout and writing another spares the passes that only rearrange.

#pragma once

#include <algorithm>
#include <type_traits>

#include "parallel.h"

namespace {

enum Layout { kPlain, kPadded, kBlocks };

// Where the pixels of images stand.
template <typename Float>
struct Pixels {
  Float* at;
  Index images, rows, columns, channels, border, fold, image, row, pixel;

  Pixels(Float* data, ffi::Span<const Index> shape, Index layout)
      : at(data), images(shape[0]), border(layout != kPlain), fold(layout == kBlocks) {
    rows = (shape[1] << fold) - 2 * border;
    columns = (shape[2] << fold) - 2 * border;
    channels = shape[3] >> 2 * fold;
    pixel = shape[3];
    row = shape[2] * pixel;
    image = shape[1] * row;
  }

  // Row r of image b, both r and the columns from -border on.
  Float* line(Index b, Index r) const {
    r += border;
    return at + b * image + (r >> fold) * row + 2 * (r & fold) * channels;
  }
  Index column(Index c) const {
    c += border;
    return (c >> fold) * pixel + (c & fold) * channels;
  }
};

Pixels<const float> pixels(const Array& array, Index layout) { return {array.typed_data(), array.dimensions(), layout}; }
Pixels<float> pixels(Result& array, Index layout) { return {array->typed_data(), array->dimensions(), layout}; }

template <Index V>
struct Vectors {
  Vector v[V] = {};
  Vectors() = default;
  explicit Vectors(const float* at) {
#pragma GCC unroll 4
    for (Index i = 0; i < V; ++i) v[i] = *reinterpret_cast<const Vector*>(at + i * kLanes);
  }
  void store(float* at) const {
#pragma GCC unroll 4
    for (Index i = 0; i < V; ++i) *reinterpret_cast<Vector*>(at + i * kLanes) = v[i];
  }
};

// Calls f(V, n) for all channels, V <= kMost vectors from channel n on.
template <Index kMost, typename F>
void for_channels(Index channels, F f, Index n = 0) {
  for (; n + kMost * kLanes <= channels; n += kMost * kLanes) f(std::integral_constant<Index, kMost>(), n);
  if constexpr (kMost > 1) for_channels<kMost - 1>(channels, f, n);
}

// Zeros around row r: its ends, and above the first or below the last row all of it.
void frame(const Pixels<float>& y, Index b, Index r) {
  if (!y.border) return;
  auto clear = [&](Index row, Index column) { std::fill_n(y.line(b, row) + y.column(column), y.channels, 0.f); };
  clear(r, -1), clear(r, y.columns);
  for (Index row : {Index(-1), y.rows})
    if (row == r - 1 || row == r + 1)
      for (Index c = -1; c <= y.columns; ++c) clear(row, c);
}

}  // namespace

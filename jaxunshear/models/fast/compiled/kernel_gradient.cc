// The kernel's gradient of a convolution without padding, for XLA on a CPU (native.py compiles it, conv.py calls it):
//
//     out[i, j, c, n] = sum over images b and places (h, w) of x[b, h + i, w + j, c] * dy[b, h, w, n]
//
// The array with fewer channels gives single numbers, the one with more gives vectors. A tile, kRows numbers times kVectors
// vectors, stays in registers over a slab of places, small enough that all shifts (i, j) find it in the second-level cache.
// No array is rearranged and no shift copied, which is what XLA's own products of shifts spend half their time on.

#include <algorithm>
#include <cstring>

#include "parallel.h"

namespace {

#if defined(__AVX512F__) || defined(__aarch64__)  // 32 registers
constexpr Index kVectors = 4;
#else  // 16
constexpr Index kVectors = 2;
#endif
constexpr Index kRows = 6;
constexpr Index kPlaces = 192;  // of a slab

// A pixel array in memory, in floats.
struct Pixels {
  const float* at;
  Index image, row, pixel;

  Pixels(const Array& array)
      : at(array.typed_data()),
        image(array.dimensions()[1] * array.dimensions()[2] * array.dimensions()[3]),
        row(array.dimensions()[2] * array.dimensions()[3]),
        pixel(array.dimensions()[3]) {}

  Pixels moved(Index rows, Index columns) const {
    Pixels other = *this;
    other.at += rows * row + columns * pixel;
    return other;
  }
};

// Rows `first` to `last` of places, counted through all images.
struct Slab {
  Index first, last, height, width;
};

// out[m, n] += numbers[m] * vectors[n] summed over a slab, for the lanes n >= skip.
template <Index M, Index V>
void tile(const Pixels& numbers, const Pixels& vectors, Index c, Index n, const Slab& slab, float* out, Index pitch, Index skip) {
  Vector sum[M][V] = {};
  const Index image = slab.first / slab.height, row = slab.first % slab.height;
  const float* left_row = numbers.at + c + image * numbers.image + row * numbers.row;
  const float* right_row = vectors.at + n + image * vectors.image + row * vectors.row;
  const Index left_jump = numbers.image - slab.height * numbers.row, right_jump = vectors.image - slab.height * vectors.row;
  Index until = slab.height - row;  // the next image
  for (Index r = slab.first; r < slab.last; ++r) {
    const float *left = left_row, *right = right_row;
    for (Index w = 0; w < slab.width; ++w, left += numbers.pixel, right += vectors.pixel) {
      Vector loaded[V];
#pragma GCC unroll 8
      for (Index v = 0; v < V; ++v) __builtin_prefetch(right + 8 * vectors.pixel + v * kLanes);
      __builtin_prefetch(left + 8 * numbers.pixel);
#pragma GCC unroll 8
      for (Index v = 0; v < V; ++v) loaded[v] = *reinterpret_cast<const Vector*>(right + v * kLanes);
#pragma GCC unroll 8
      for (Index m = 0; m < M; ++m)
#pragma GCC unroll 8
        for (Index v = 0; v < V; ++v) sum[m][v] += left[m] * loaded[v];
    }
    left_row += numbers.row, right_row += vectors.row;
    if (--until == 0) left_row += left_jump, right_row += right_jump, until = slab.height;
  }
  for (Index m = 0; m < M; ++m)
    for (Index v = 0; v < V; ++v) {
      float* to = out + m * pitch + v * kLanes;
      if (skip == 0)
        *reinterpret_cast<Vector*>(to) += sum[m][v];
      else
        for (Index lane = std::max<Index>(0, skip - v * kLanes); lane < kLanes; ++lane) to[lane] += sum[m][v][lane];
    }
}

using Tile = decltype(&tile<1, 1>);
template <Index V>
constexpr Tile kTilesOf[] = {tile<1, V>, tile<2, V>, tile<3, V>, tile<4, V>, tile<5, V>, tile<6, V>};
constexpr const Tile* kTiles[] = {
    kTilesOf<1>, kTilesOf<2>,
#if defined(__AVX512F__) || defined(__aarch64__)
    kTilesOf<3>, kTilesOf<4>,
#endif
};

// All of `out` (numbers, vectors) for the numbers c of first <= c < last. The last vector reaches back where lanes are left over.
void add(const Pixels& numbers, const Pixels& vectors, Index first, Index last, const Slab& slab, float* out) {
  const Index count = vectors.pixel;
  for (Index n = 0; n < count;) {
    const Index full = std::min(kVectors, (count - n) / kLanes);
    const Index at = full ? n : count - kLanes;
    for (Index c = first; c < last; c += kRows) {
      const Tile run = kTiles[std::max<Index>(full, 1) - 1][std::min(kRows, last - c) - 1];
      run(numbers, vectors, c, at, slab, out + c * count + at, count, n - at);
    }
    n = at + std::max<Index>(full, 1) * kLanes;
  }
}

// x (B, H, W, C), dy (B, H - k + 1, W - k + 1, N) -> (P, k * k, C, N), or (P, k * k, N, C) if C > N; the larger of both >= kLanes.
// The outermost `border` pixels of x are zeros. The sums of P groups of images stand apart, so that threads read different ones.
// Every number of the result is summed by one thread in one order, however many there are.
ffi::Future kernel_gradient(ffi::ThreadPool pool, Array x, Array dy, Index k, Index border, Result out) {
  const Index images = x.dimensions()[0], height = x.dimensions()[1], width = x.dimensions()[2], groups = out->dimensions()[0];
  const bool x_first = x.dimensions()[3] <= dy.dimensions()[3];
  const Pixels x_pixels(x), dy_pixels(dy);
  const Index channels = std::min(x_pixels.pixel, dy_pixels.pixel), size = x_pixels.pixel * dy_pixels.pixel, shifts = k * k;
  const Index wanted = (pool.num_threads() + groups - 1) / groups;  // threads for a group
  const Index parts = std::clamp<Index>(wanted, 1, (channels + kRows - 1) / kRows), per = (channels + parts - 1) / parts;
  const Index turns = std::clamp<Index>((wanted + parts - 1) / parts, 1, shifts);
  float* const result = out->typed_data();
  return parallel(pool, groups * parts * turns, [=](Index unit) {
    const Index group = unit / (parts * turns), first = unit % parts * per, last = std::min(channels, first + per);
    if (first >= last) return;
    float* const sums = result + group * shifts * size;
    const Index begin = group * images / groups, end = (group + 1) * images / groups;
    const Index rows = (end - begin) * std::min(height - 2 * border, height - k + 1);
    const Index step = std::max<Index>(1, kPlaces / std::max<Index>(1, width));
    const Index turn = unit / parts % turns;
    for (Index shift = turn; shift < shifts; shift += turns)
      std::memset(sums + shift * size + first * (size / channels), 0, sizeof(float) * (last - first) * (size / channels));
    for (Index row = 0; row < rows; row += step)
      for (Index shift = turn; shift < shifts; shift += turns) {
        const Index i = shift / k, j = shift % k;  // of x, the pixels that are no border and that dy has
        const Index top = std::max(border, i), bottom = std::min(height - border, height - k + 1 + i);
        const Index left = std::max(border, j), right = std::min(width - border, width - k + 1 + j);
        if (top >= bottom || left >= right) continue;
        const Pixels from = x_pixels.moved(top, left), by = dy_pixels.moved(top - i, left - j);
        const Index before = begin * (bottom - top), after = end * (bottom - top);
        const Slab slab{before + row, std::min(after, before + row + step), bottom - top, right - left};
        add(x_first ? from : by, x_first ? by : from, first, last, slab, sums + shift * size);
      }
  });
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(
    KernelGradient, kernel_gradient,
    ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Array>().Arg<Array>().Attr<Index>("k").Attr<Index>("border").Ret<ffi::Buffer<ffi::F32>>());

// The kernel's gradient of a convolution without padding, for XLA on a CPU (native.py compiles it, conv.py calls it):
//
//     out[i, j, c, n] = sum over images b and places (h, w) of x[b, h + i, w + j, c] * dy[b, h, w, n]
//
// The array with fewer channels gives single numbers, the one with more gives vectors. A tile, kRows numbers times kVectors
// vectors, stays in registers over a slab of places, small enough that all shifts (i, j) find it in the second-level cache.
// No array is rearranged and no shift copied, which is what XLA's own products of shifts spend half their time on.

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>
#include <memory>

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using Index = int64_t;
using Array = ffi::Buffer<ffi::F32, 4>;

#if defined(__AVX512F__)  // 32 registers of 16 floats
constexpr Index kLanes = 16, kVectors = 4;
#elif defined(__AVX__)  // 16 of 8
constexpr Index kLanes = 8, kVectors = 2;
#elif defined(__aarch64__)  // 32 of 4
constexpr Index kLanes = 4, kVectors = 4;
#else  // 16 of 4
constexpr Index kLanes = 4, kVectors = 2;
#endif
constexpr Index kRows = 6;
constexpr Index kPlaces = 512;  // of a slab
typedef float Vector __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));

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
  for (Index r = slab.first; r < slab.last; ++r) {
    const float* left = numbers.at + c + r / slab.height * numbers.image + r % slab.height * numbers.row;
    const float* right = vectors.at + n + r / slab.height * vectors.image + r % slab.height * vectors.row;
    for (Index w = 0; w < slab.width; ++w, left += numbers.pixel, right += vectors.pixel) {
      Vector loaded[V];
#pragma GCC unroll 8
      for (Index v = 0; v < V; ++v) loaded[v] = *reinterpret_cast<const Vector*>(right + v * kLanes);
#pragma GCC unroll 8
      for (Index m = 0; m < M; ++m)
#pragma GCC unroll 8
        for (Index v = 0; v < V; ++v) sum[m][v] += left[m] * loaded[v];
    }
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
    const Index whole = std::min(kVectors, (count - n) / kLanes);
    const Index at = whole ? n : count - kLanes;
    for (Index c = first; c < last; c += kRows) {
      const Tile run = kTiles[std::max<Index>(whole, 1) - 1][std::min(kRows, last - c) - 1];
      run(numbers, vectors, c, at, slab, out + c * count + at, count, n - at);
    }
    n = at + std::max<Index>(whole, 1) * kLanes;
  }
}

// x (B, H, W, C), dy (B, H - k + 1, W - k + 1, N) -> (k * k, C, N), or (k * k, N, C) if C > N; the larger of both >= kLanes.
// The outermost `border` pixels of x are zeros. Every number of the result is summed by one thread in one order, however many there are.
ffi::Future kernel_gradient(ffi::ThreadPool pool, Array x, Array dy, Index k, Index border, ffi::ResultBuffer<ffi::F32> out) {
  const Index images = x.dimensions()[0], height = x.dimensions()[1], width = x.dimensions()[2];
  const bool x_first = x.dimensions()[3] <= dy.dimensions()[3];
  const Pixels x_pixels(x), dy_pixels(dy);
  const Index channels = std::min(x_pixels.pixel, dy_pixels.pixel), size = x_pixels.pixel * dy_pixels.pixel, shifts = k * k;
  const Index threads = std::max<Index>(1, pool.num_threads());
  const Index parts = std::min(threads, (channels + kRows - 1) / kRows), per = (channels + parts - 1) / parts;
  const Index groups = std::min(shifts, (threads + parts - 1) / parts);
  float* const result = out->typed_data();
  auto next = std::make_shared<std::atomic<Index>>(0);

  auto work = [=] {
    for (Index unit; (unit = (*next)++) < parts * groups;) {
      const Index first = unit % parts * per, last = std::min(channels, first + per), group = unit / parts;
      if (first >= last) continue;
      for (Index shift = group; shift < shifts; shift += groups)
        std::memset(result + shift * size + first * (size / channels), 0, sizeof(float) * (last - first) * (size / channels));
      const Index rows = images * std::min(height - 2 * border, height - k + 1);
      const Index step = std::max<Index>(1, kPlaces / std::max<Index>(1, width));
      for (Index row = 0; row < rows; row += step)
        for (Index shift = group; shift < shifts; shift += groups) {
          const Index i = shift / k, j = shift % k;  // of x, the pixels that are no border and that dy has
          const Index top = std::max(border, i), bottom = std::min(height - border, height - k + 1 + i);
          const Index left = std::max(border, j), right = std::min(width - border, width - k + 1 + j);
          const Pixels from = x_pixels.moved(top, left), by = dy_pixels.moved(top - i, left - j);
          const Slab slab{row, std::min(images * (bottom - top), row + step), bottom - top, right - left};
          add(x_first ? from : by, x_first ? by : from, first, last, slab, result + shift * size);
        }
    }
  };
  ffi::CountDownPromise done(threads);
  ffi::Future future(done);
  for (Index thread = 0; thread < threads; ++thread)
    pool.Schedule([=]() mutable {
      work();
      done.CountDown();
    });
  return future;
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(
    KernelGradient, kernel_gradient,
    ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Array>().Arg<Array>().Attr<Index>("k").Attr<Index>("border").Ret<ffi::Buffer<ffi::F32>>());

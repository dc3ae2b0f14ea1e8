// The 4x4 convolution of stride 2 next to an image of one channel, for XLA on a CPU (native.py compiles it, outermost.py calls it).
//
// All three are slopes of one sum, over pixels (i, j) of half the image's size, taps (k, l) and channels c:
//
//     image[2i - 1 + k, 2j - 1 + l] * kernel[k, l, c] * blocks[i, j, c]
//
// gather that of `blocks`, scatter that of the image, outer that of the kernel. Channels, or for scatter the 16 taps, fill the vectors.

#include <algorithm>
#include <type_traits>
#include <vector>

#include "layouts.h"
#include "parallel.h"

namespace {

using Kernel = ffi::Buffer<ffi::F32, 2>;

constexpr Index kTaps = 16;
constexpr Index kTile = kLanes == 16 ? 8 : 4;  // pixels, or taps, whose sums stay in registers
constexpr Index kBand = 8;                     // rows of pixels of one unit of scatter

typedef float Pair __attribute__((vector_size(8), aligned(4), may_alias));
inline Pair pair(const float* at) { return *reinterpret_cast<const Pair*>(at); }

// The four rows of the image that a row of pixels reads, with zeros outside.
class Strip {
 public:
  Strip(const float* image, Index side) : image_(image), side_(side), rows_(4 * (side + 2)) {}

  void read(Index row) {
    for (Index k = 0; k < 4; ++k) {
      const Index r = 2 * row - 1 + k;
      float* const to = rows_.data() + k * (side_ + 2);
      if (r < 0 || r >= side_) std::fill_n(to, side_ + 2, 0.f);
      else std::copy_n(image_ + r * side_, side_, to + 1);
    }
  }
  const float* tap(Index k, Index column) const { return rows_.data() + k * (side_ + 2) + 2 * column; }

 private:
  const float* image_;
  Index side_;
  std::vector<float> rows_;
};

// Calls f(P, j) for all columns, P = kTile of them from column j on; the last tile reaches back.
template <typename F>
void for_columns(Index columns, F f) {
  for (Index j = 0; j < columns; ++j) {
    if (columns < kTile) f(std::integral_constant<Index, 1>(), j);
    else f(std::integral_constant<Index, kTile>(), std::min(j, columns - kTile)), j += kTile - 1;
  }
}

// image (B, S, S, 1), kernel (16, C) -> blocks (B, S/4 + 1, S/4 + 1, 4 C), zero outside.
ffi::Future gather(ffi::ThreadPool pool, Array image, Kernel kernel, Result out) {
  const auto y = pixels(out, kBlocks);
  const float *from = image.typed_data(), *weights = kernel.typed_data();
  return parallel(pool, y.images * y.rows, [=](Index unit) {
    const Index b = unit / y.rows, i = unit % y.rows, side = 2 * y.rows;
    Strip strip(from + b * side * side, side);
    strip.read(i);
    frame(y, b, i);
    for_channels<2>(y.channels, [&](auto width, Index n) {
      constexpr Index V = decltype(width)::value;
      for_columns(y.columns, [&](auto many, Index j) {
        constexpr Index P = decltype(many)::value;
        Vectors<V> sum[P];
        for (Index k = 0; k < 4; ++k) {
          const float* const row = strip.tap(k, j);
#pragma GCC unroll 4
          for (Index l = 0; l < 4; ++l) {
            const Vectors<V> weight(weights + (4 * k + l) * y.channels + n);
#pragma GCC unroll 8
            for (Index p = 0; p < P; ++p)
#pragma GCC unroll 2
              for (Index v = 0; v < V; ++v) sum[p].v[v] += row[2 * p + l] * weight.v[v];
          }
        }
#pragma GCC unroll 8
        for (Index p = 0; p < P; ++p) sum[p].store(y.line(b, i) + y.column(j + p) + n);
      });
    });
  });
}

// All taps of the pixels of a row: to[16 j + tap].
void taps(const Pixels<const float>& x, Index b, Index i, const float* turned, float* to) {
  constexpr Index V = kTaps / kLanes;
  const float* const line = x.line(b, i);
  for_columns(x.columns, [&](auto many, Index j) {
    constexpr Index P = decltype(many)::value;
    Vectors<V> sum[P];
    const float* pixel[P];
#pragma GCC unroll 8
    for (Index p = 0; p < P; ++p) pixel[p] = line + x.column(j + p);
    for (Index c = 0; c < x.channels; ++c) {
      const Vectors<V> weight(turned + c * kTaps);
#pragma GCC unroll 8
      for (Index p = 0; p < P; ++p)
#pragma GCC unroll 4
        for (Index v = 0; v < V; ++v) sum[p].v[v] += pixel[p][c] * weight.v[v];
    }
#pragma GCC unroll 8
    for (Index p = 0; p < P; ++p) sum[p].store(to + kTaps * (j + p));
  });
}

// blocks (B, S/4 + 1, S/4 + 1, 4 C), the kernel turned (C, 16) -> image (B, S, S, 1).
ffi::Future scatter(ffi::ThreadPool pool, Array data, Kernel kernel, Result out) {
  const auto x = pixels(data, kBlocks);
  float* const to = out->typed_data();
  const float* const turned = kernel.typed_data();
  const Index bands = (x.rows + kBand) / kBand;  // of rows -1 to x.rows - 1, each with the next one
  return parallel(pool, x.images * bands, [=](Index unit) {
    const Index b = unit / bands, first = unit % bands * kBand - 1, last = std::min(x.rows, first + kBand), side = 2 * x.rows;
    // taps of this row of pixels and the next, with zeros for the pixels outside
    std::vector<float> memory(2 * kTaps * (x.columns + 2));
    float *here = memory.data() + kTaps, *next = here + kTaps * (x.columns + 2);
    if (first >= 0) taps(x, b, first, turned, here);
    for (Index i = first; i < last; ++i) {
      if (i + 1 < x.rows) taps(x, b, i + 1, turned, next);
      else std::fill_n(next, kTaps * x.columns, 0.f);
      for (Index a = 0; a < 2; ++a) {
        const Index r = 2 * i + 1 + a;
        if (r < 0 || r >= side) continue;
        float* const row = to + (b * side + r) * side;
        // pixel j and its neighbour to the right reach the columns 2j + 1 and 2j + 2
        const auto reach = [&](Index j) {
          const float *upper = here + kTaps * j + 4 * (2 + a), *lower = next + kTaps * j + 4 * a;
          return (pair(upper + 2) + pair(upper + kTaps)) + (pair(lower + 2) + pair(lower + kTaps));
        };
        row[0] = reach(-1)[1];
        for (Index j = 0; j < x.columns - 1; ++j) *reinterpret_cast<Pair*>(row + 2 * j + 1) = reach(j);
        row[side - 1] = reach(x.columns - 1)[0];
      }
      std::swap(here, next);
    }
  });
}

// image (B, S, S, 1), blocks (B, S/4 + 1, S/4 + 1, 4 C) -> each image's sums for the kernel (B, 16, C).
ffi::Future outer(ffi::ThreadPool pool, Array image, Array data, ffi::ResultBuffer<ffi::F32> out) {
  const auto x = pixels(data, kBlocks);
  const float* const from = image.typed_data();
  float* const to = out->typed_data();
  return parallel(pool, x.images, [=](Index b) {
    const Index side = 2 * x.rows;
    float* const result = to + b * kTaps * x.channels;
    std::fill_n(result, kTaps * x.channels, 0.f);
    Strip strip(from + b * side * side, side);
    for (Index i = 0; i < x.rows; ++i) {
      strip.read(i);
      const float* const line = x.line(b, i);
      for_channels<2>(x.channels, [&](auto width, Index n) {
        constexpr Index V = decltype(width)::value;
        for (Index first = 0; first < kTaps; first += kTile) {
          constexpr Index rows = kTile / 4;
          Vectors<V> sum[kTile];
          const float* row[rows];
          for (Index k = 0; k < rows; ++k) row[k] = strip.tap(first / 4 + k, 0);
          for (Index j = 0; j < x.columns; ++j) {
            const Vectors<V> value(line + x.column(j) + n);
#pragma GCC unroll 2
            for (Index k = 0; k < rows; ++k)
#pragma GCC unroll 4
              for (Index l = 0; l < 4; ++l)
#pragma GCC unroll 2
                for (Index v = 0; v < V; ++v) sum[4 * k + l].v[v] += row[k][2 * j + l] * value.v[v];
          }
#pragma GCC unroll 8
          for (Index t = 0; t < kTile; ++t) {
            float* const at = result + (first + t) * x.channels + n;
            const Vectors<V> before(at);
            for (Index v = 0; v < V; ++v) sum[t].v[v] += before.v[v];
            sum[t].store(at);
          }
        }
      });
    }
  });
}

}  // namespace

#define RETURNS Ret<ffi::Buffer<ffi::F32>>()
XLA_FFI_DEFINE_HANDLER_SYMBOL(Gather, gather, ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Array>().Arg<Kernel>().RETURNS);
XLA_FFI_DEFINE_HANDLER_SYMBOL(Scatter, scatter, ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Array>().Arg<Kernel>().RETURNS);
XLA_FFI_DEFINE_HANDLER_SYMBOL(Outer, outer, ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Array>().Arg<Array>().RETURNS);

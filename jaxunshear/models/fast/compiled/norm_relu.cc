// Batch normalisation and ReLU between the layouts of an image, for XLA on a CPU (native.py compiles it, norm.py calls it).

#include <algorithm>

#include "layouts.h"
#include "parallel.h"

namespace {

using Channels = ffi::Buffer<ffi::F32, 1>;

// Calls f(r, c) for all columns of rows first <= r < last, two rows of a block together.
template <typename F>
void in_pairs(Index first, Index last, Index columns, F f) {
  for (Index r = first; r < last;) {
    if (r % 2 == 1 && r + 1 < last) {
      for (Index c = 0; c < columns; ++c) f(r, c), f(r + 1, c);
      r += 2;
    } else {
      for (Index c = 0; c < columns; ++c) f(r, c);
      r += 1;
    }
  }
}

// Calls work(b, first, last) for the rows of all images of y, those of a block together, and frames them with zeros.
template <typename F>
ffi::Future in_blocks(ffi::ThreadPool pool, const Pixels<float>& y, F work) {
  const Index pairs = y.rows / 2 + 1;
  return parallel(pool, y.images * pairs, [=](Index unit) {
    const Index b = unit / pairs, pair = unit % pairs, first = std::max<Index>(0, 2 * pair - 1), last = std::min(y.rows, 2 * pair + 1);
    for (Index r = first; r < last; ++r) frame(y, b, r);
    work(b, first, last);
  });
}

// Mean and mean squared deviation of every band's pixels: (bands, 2, channels).
ffi::Future moments(ffi::ThreadPool pool, Array data, Index layout, Result out) {
  const auto x = pixels(data, layout);
  const Index bands = out->dimensions()[0] / x.images, rows = x.rows / bands;
  float* const result = out->typed_data();
  return parallel(pool, x.images * bands, [=](Index unit) {
    const Index b = unit / bands, first = unit % bands * rows;
    const float share = 1.f / (rows * x.columns);
    float* const to = result + unit * 2 * x.channels;
    for_channels<4>(x.channels, [&](auto width, Index n) {
      constexpr Index V = decltype(width)::value;
      Vectors<V> mean, variance;
      in_pairs(first, first + rows, x.columns, [&](Index r, Index c) {
        const Vectors<V> value(x.line(b, r) + x.column(c) + n);
        for (Index i = 0; i < V; ++i) mean.v[i] += value.v[i];
      });
      for (Index i = 0; i < V; ++i) mean.v[i] *= share;
      in_pairs(first, first + rows, x.columns, [&](Index r, Index c) {
        const Vectors<V> value(x.line(b, r) + x.column(c) + n);
        for (Index i = 0; i < V; ++i) variance.v[i] += (value.v[i] - mean.v[i]) * (value.v[i] - mean.v[i]);
      });
      for (Index i = 0; i < V; ++i) variance.v[i] *= share;
      mean.store(to + n), variance.store(to + x.channels + n);
    });
  });
}

// max(x * factor + shift, 0) in another layout.
ffi::Future affine_relu(ffi::ThreadPool pool, Array data, Channels factors, Channels shifts, Index from, Index to, Result out) {
  const auto x = pixels(data, from);
  const auto y = pixels(out, to);
  const float *factor_at = factors.typed_data(), *shift_at = shifts.typed_data();
  return in_blocks(pool, y, [=](Index b, Index first, Index last) {
    for_channels<4>(x.channels, [&](auto width, Index n) {
      constexpr Index V = decltype(width)::value;
      const Vectors<V> factor(factor_at + n), shift(shift_at + n);
      in_pairs(first, last, x.columns, [&](Index r, Index c) {
        Vectors<V> value(x.line(b, r) + x.column(c) + n);
        for (Index i = 0; i < V; ++i) {
          value.v[i] = value.v[i] * factor.v[i] + shift.v[i];
          value.v[i] = value.v[i] < 0 ? Vector{} : value.v[i];  // NaN stays
        }
        value.store(y.line(b, r) + y.column(c) + n);
      });
    });
  });
}

// Of the gradient dy that ReLU lets through: its sum, and its sum with x - mean, over every band: (bands, 2, channels).
ffi::Future slopes(ffi::ThreadPool pool, Array data, Array cotangent, Channels factors, Channels shifts, Channels means, Index from,
                   Index to, Result out) {
  const auto x = pixels(data, from);
  const auto dy = pixels(cotangent, to);
  const float *factor_at = factors.typed_data(), *shift_at = shifts.typed_data(), *mean_at = means.typed_data();
  const Index bands = out->dimensions()[0] / x.images, rows = x.rows / bands;
  float* const result = out->typed_data();
  return parallel(pool, x.images * bands, [=](Index unit) {
    const Index b = unit / bands, first = unit % bands * rows;
    float* const sums = result + unit * 2 * x.channels;
    for_channels<4>(x.channels, [&](auto width, Index n) {
      constexpr Index V = decltype(width)::value;
      const Vectors<V> factor(factor_at + n), shift(shift_at + n), mean(mean_at + n);
      Vectors<V> sum, product;
      in_pairs(first, first + rows, x.columns, [&](Index r, Index c) {
        const Vectors<V> value(x.line(b, r) + x.column(c) + n), slope(dy.line(b, r) + dy.column(c) + n);
        for (Index i = 0; i < V; ++i) {
          const Vector passed = value.v[i] * factor.v[i] + shift.v[i] > 0 ? slope.v[i] : Vector{};
          sum.v[i] += passed;
          product.v[i] += passed * (value.v[i] - mean.v[i]);
        }
      });
      sum.store(sums + n), product.store(sums + x.channels + n);
    });
  });
}

// The gradient of x: factor * (dy that passes) - constant - (x - mean) * tilt.
ffi::Future gradient(ffi::ThreadPool pool, Array data, Array cotangent, Channels factors, Channels shifts, Channels means,
                     Channels constants, Channels tilts, Index from, Index to, Result out) {
  const auto x = pixels(data, from);
  const auto dy = pixels(cotangent, to);
  const auto dx = pixels(out, from);
  const float *factor_at = factors.typed_data(), *shift_at = shifts.typed_data(), *mean_at = means.typed_data();
  const float *constant_at = constants.typed_data(), *tilt_at = tilts.typed_data();
  return in_blocks(pool, dx, [=](Index b, Index first, Index last) {
    for_channels<4>(x.channels, [&](auto width, Index n) {
      constexpr Index V = decltype(width)::value;
      const Vectors<V> factor(factor_at + n), shift(shift_at + n), mean(mean_at + n), constant(constant_at + n), tilt(tilt_at + n);
      in_pairs(first, last, x.columns, [&](Index r, Index c) {
        const Vectors<V> value(x.line(b, r) + x.column(c) + n), slope(dy.line(b, r) + dy.column(c) + n);
        Vectors<V> result;
        for (Index i = 0; i < V; ++i) {
          const Vector passed = value.v[i] * factor.v[i] + shift.v[i] > 0 ? slope.v[i] * factor.v[i] : Vector{};
          result.v[i] = passed - (constant.v[i] + (value.v[i] - mean.v[i]) * tilt.v[i]);
        }
        result.store(dx.line(b, r) + dx.column(c) + n);
      });
    });
  });
}

}  // namespace

#define BIND ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Array>()
#define LAYOUTS Attr<Index>("source").Attr<Index>("target").Ret<ffi::Buffer<ffi::F32>>()
XLA_FFI_DEFINE_HANDLER_SYMBOL(Moments, moments, BIND.Attr<Index>("source").Ret<ffi::Buffer<ffi::F32>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(AffineRelu, affine_relu, BIND.Arg<Channels>().Arg<Channels>().LAYOUTS);
XLA_FFI_DEFINE_HANDLER_SYMBOL(Slopes, slopes, BIND.Arg<Array>().Arg<Channels>().Arg<Channels>().Arg<Channels>().LAYOUTS);
XLA_FFI_DEFINE_HANDLER_SYMBOL(
    Gradient, gradient,
    BIND.Arg<Array>().Arg<Channels>().Arg<Channels>().Arg<Channels>().Arg<Channels>().Arg<Channels>().LAYOUTS);

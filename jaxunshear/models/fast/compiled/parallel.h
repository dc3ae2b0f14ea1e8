// What the compiled parts share: vectors of this processor, and loops over XLA's threads.

#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using Index = int64_t;
using Array = ffi::Buffer<ffi::F32, 4>;
using Result = ffi::ResultBuffer<ffi::F32>;

#if defined(__AVX512F__)  // 32 registers of 16 floats
constexpr Index kLanes = 16;
#elif defined(__AVX__)  // 16 of 8
constexpr Index kLanes = 8;
#else  // of 4
constexpr Index kLanes = 4;
#endif
typedef float Vector __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));

// work(0) to work(count - 1), in any order, by as many threads as XLA has.
template <typename Work>
ffi::Future parallel(ffi::ThreadPool pool, Index count, Work work) {
  const Index threads = std::clamp<Index>(pool.num_threads(), 1, std::max<Index>(1, count));
  auto next = std::make_shared<std::atomic<Index>>(0);
  ffi::CountDownPromise done(threads);
  ffi::Future future(done);
  for (Index thread = 0; thread < threads; ++thread)
    pool.Schedule([=]() mutable {
      for (Index unit; (unit = (*next)++) < count;) work(unit);
      done.CountDown();
    });
  return future;
}

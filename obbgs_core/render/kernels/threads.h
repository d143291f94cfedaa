// One pool of waiting threads for every parallel loop of this module.
#pragma once
#include <cstddef>
#include <functional>

namespace obbgs {

// Runs work(0) .. work(units - 1) on the caller and up to `threads - 1` helpers, handed out one by one.
//
// Made for cores that others use too: helpers sleep when no loop follows soon, the caller waits only for those that have begun, and
// after a late one (its core was taken) works alone for a while. A second caller at the same time runs alone. The first exception of any
// unit is thrown again when all have ended.
void parallel_for(int units, int threads, const std::function<void(int)>& work);

// Of `threads`, as many as have at least `grain` items each: waking a helper for less than about a millisecond costs more than it gives.
inline int worthwhile(int threads, size_t items, size_t grain) {
  const size_t most = items / grain;
  return most < size_t(threads) ? (most ? int(most) : 1) : threads;
}

}  // namespace obbgs

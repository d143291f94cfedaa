// One pool of threads for every parallel loop of this module.
#pragma once
#include <cstddef>
#include <functional>

namespace obbgs {

// Runs work(0) .. work(units - 1) on the caller and up to `threads - 1` helper threads, which take one unit after
// another.
//
// Made for cores that are shared with other programs: helpers sleep unless the next loop follows soon, the caller waits
// only for helpers that have begun, and after a helper was late (its core was busy) the next loops run without any. A
// second caller at the same time runs its loop alone. The first exception of any unit is thrown again when all have
// ended.
void parallel_for(int units, int threads, const std::function<void(int)>& work);

// Returns how many of `threads` have at least `grain` items each: a helper that works for less than about a millisecond
// takes longer to wake than it saves.
inline int worthwhile(int threads, size_t items, size_t grain) {
  const size_t most = items / grain;
  return most < size_t(threads) ? (most ? int(most) : 1) : threads;
}

}  // namespace obbgs

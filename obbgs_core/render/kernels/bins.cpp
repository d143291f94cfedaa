// Depth order and binning: one radix sort of all visible splats, then stable binning into tiles.
#include <algorithm>
#include <utility>
#include <vector>

#include "machine/threads.h"
#include "projection.h"
#include "tiles.h"

namespace obbgs {
namespace KERNEL {
namespace {

// Stable least-significant-digit radix sort; bits of positive floats are ordered like their values.
void sort_by_depth(Buffer<DepthKey>& keys, size_t count) {
  constexpr int kDigit = 11, kValues = 1 << kDigit, kPasses = 3;
  Buffer<DepthKey> other;
  other.resize(count);
  std::vector<uint32_t> begin(kPasses * kValues, 0);
  for (size_t i = 0; i < count; ++i)
    for (int pass = 0; pass < kPasses; ++pass)
      ++begin[pass * kValues + ((keys[i].depth_bits >> (pass * kDigit)) & (kValues - 1))];
  for (int pass = 0; pass < kPasses; ++pass) {
    uint32_t* next = &begin[pass * kValues];
    if (count && next[(keys[0].depth_bits >> (pass * kDigit)) & (kValues - 1)] == count)
      continue;  // this digit is the same everywhere
    uint32_t total = 0;
    for (int v = 0; v < kValues; ++v) total += std::exchange(next[v], total);
    for (size_t i = 0; i < count; ++i) other[next[(keys[i].depth_bits >> (pass * kDigit)) & (kValues - 1)]++] = keys[i];
    std::swap(keys, other);
  }
}

}  // namespace

void bin(const Scene& s, Frame& frame, int threads) {
  sort_by_depth(frame.visible, frame.visible_count);
  const size_t count = frame.visible_count, tile_count = tiles(s), n = s.gaussians;
  const size_t chunk = std::max<size_t>(256, (count + 63) / 64), chunks = (count + chunk - 1) / chunk;
  frame.first_record.resize(frame.found.size());
  uint32_t records = 0;
  for (size_t g = 0; g < frame.found.size(); ++g) {
    frame.first_record[g] = records;
    records += uint32_t(frame.found[g].size());
  }
  // calls visit(splat, record, found) for each tile of the splats of a chunk, nearest first
  const auto for_each_pair = [&](size_t c, auto visit) {
    const size_t end = std::min(count, (c + 1) * chunk);
    const auto at = [&](size_t i) -> const Splat& { return frame.splats[frame.visible[i].splat]; };
    const auto group = [&](size_t i) { return frame.visible[i].splat % n / kChunk; };
    for (size_t i = c * chunk; i < end; ++i) {
      if (i + 16 < end) __builtin_prefetch(&at(i + 16));
      if (i + 8 < end) __builtin_prefetch(frame.found[group(i + 8)].data() + at(i + 8).first_record);
      const Found* found = frame.found[group(i)].data();
      const uint32_t first = at(i).first_record, record = frame.first_record[group(i)];
      for (uint32_t r = first; r < first + at(i).records; ++r) visit(frame.visible[i].splat, record + r, found[r]);
    }
  };
  std::vector<uint32_t> next(chunks * tile_count,
                             0);  // first the number of pairs of each chunk in each tile, then where they are put
  const int useful = worthwhile(threads, count, kSplatsPerThread);
  parallel_for(int(chunks), useful, [&](int c) {
    for_each_pair(c, [&](uint32_t, uint32_t, const Found& f) { ++next[c * tile_count + f.tile]; });
  });
  frame.tile_begin.resize(tile_count + 1);
  uint32_t total = 0;
  for (size_t t = 0; t < tile_count; ++t) {
    frame.tile_begin[t] = total;
    for (size_t c = 0; c < chunks; ++c) total += std::exchange(next[c * tile_count + t], total);
  }
  frame.tile_begin[tile_count] = total;
  frame.pairs.resize(total);
  parallel_for(int(chunks), useful, [&](int c) {
    for_each_pair(c, [&](uint32_t splat, uint32_t record, const Found& f) {
      frame.pairs[next[c * tile_count + f.tile]++] = {splat, record, f.blocks};
    });
  });
  frame.found = {};
}

}  // namespace KERNEL
}  // namespace obbgs

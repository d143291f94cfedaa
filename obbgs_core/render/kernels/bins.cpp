// Depth order and binning: one radix sort of all visible splats, then stable binning into tiles.
#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "machine/threads.h"
#include "tiles.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr size_t kSplatsPerThread = 8192;  // with fewer, another thread takes longer to wake than it saves

struct Found {  // a pair and the tile it belongs to
  uint32_t tile, splat;
  uint64_t blocks;
};

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

// Returns a place in the image, px, rounded down; places far outside, which int could not hold, are moved closer.
inline int pixel(float place) { return int(std::min(std::max(0.0f, place), 1e6f)); }

// Appends a pair for each tile where the splat's ellipse reaches a pixel centre. A block is marked
// where the ellipse meets the rectangle of its outermost pixel centres; a vector of rows of blocks is computed at a
// time, which is those of one tile or of two.
void find_pairs(const Scene& s, const Splat& splat, uint32_t index, std::vector<Found>& found) {
  const int blocks_y = (s.height + kBlockHeight - 1) / kBlockHeight, across = tiles_x(s);
  const uint32_t first_tile = index / uint32_t(s.gaussians) * uint32_t(across * tiles_y(s));
  const float q = splat.reach, root = std::sqrt(q);
  const float tilt = splat.k2 / splat.k3, stretch = std::sqrt(1 + tilt * tilt);
  const float narrow = 1 / splat.k1, widest = root * narrow * stretch, tallest = root / splat.k3;
  const float slack =
      0.01f + 1e-6f * (std::abs(splat.x) + std::abs(splat.y) + widest + tallest);  // px, covers rounding
  const float reach_x = widest + slack, reach_y = tallest + slack;
  const float turn =
      tilt * tallest / stretch;  // the rightmost point of the ellipse is at dy = -turn, the leftmost at turn
  // the first and last row of blocks, and tile, whose pixel centres are within reach
  const int row0 = pixel(splat.y - reach_y + 0.5f) / kBlockHeight;
  const int row1 = std::min(pixel(splat.y + reach_y - 0.5f) / kBlockHeight, blocks_y - 1);
  const int tile0 = pixel(splat.x - reach_x + 0.5f) / kTileWidth;
  const int tile1 = std::min(pixel(splat.x + reach_x - 0.5f) / kTileWidth, across - 1);

  alignas(64) static constexpr float kRows[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  constexpr int kTilesAtOnce = kLanes / 8;
  const vf rows = load(kRows);
  for (int tile_y = row0 / 8; tile_y <= row1 / 8; tile_y += kTilesAtOnce) {
    const vf row = rows + float(tile_y * 8);
    const vf top = row * float(kBlockHeight) + (0.5f - splat.y);  // its first pixel centre, from the mean
    const vf from = larger(top, -reach_y), to = smaller(top + float(kBlockHeight - 1), reach_y);
    const mask inside = (from <= to) & (row < vf(float(blocks_y)));
    const vf at_right = larger(smaller(-turn, to), from), at_left = larger(smaller(turn, to), from);
    const auto half_width = [&](vf dy) { return sqrt(larger(vf(q) - (dy * splat.k3) * (dy * splat.k3), 0.0f)); };
    const vf right = (half_width(at_right) - at_right * splat.k2) * narrow + (splat.x + slack);
    const vf left = (-half_width(at_left) - at_left * splat.k2) * narrow + (splat.x - slack);
    for (int tile_x = tile0; tile_x <= tile1; ++tile_x) {
      // columns begin .. end - 1: their pixel centres 4b + 0.5 .. 4b + 3.5 reach into left .. right
      const float x0 = float(tile_x * kTileWidth);
      const int blocks_left = (s.width - tile_x * kTileWidth + kBlockWidth - 1) / kBlockWidth;
      const float columns = float(std::min(8, blocks_left));
      const vf begin =
          larger(smaller((left - (x0 + 3.5f)) * (1.0f / kBlockWidth), columns), 0.0f) + 0.999999f;  // rounded up
      const vf end = zero_unless(inside, larger(smaller((right - (x0 - 3.5f)) * (1.0f / kBlockWidth), columns), 0.0f));
      const vi bits = (vi(1) << truncate(end)) - vi(1), skipped = (vi(1) << truncate(begin)) - vi(1);
      uint64_t blocks[kTilesAtOnce];
      store_bytes(blocks, bits & ~skipped);
      for (int t = 0; t < kTilesAtOnce; ++t)
        if (blocks[t]) found.push_back({first_tile + uint32_t((tile_y + t) * across + tile_x), index, blocks[t]});
    }
  }
}

}  // namespace

void bin(const Scene& s, Frame& frame, int threads) {
  sort_by_depth(frame.visible, frame.visible_count);
  const size_t count = frame.visible_count, tile_count = tiles(s);
  const size_t chunk = std::max<size_t>(256, (count + 63) / 64), chunks = (count + chunk - 1) / chunk;
  std::vector<std::vector<Found>> found(chunks);
  std::vector<uint32_t> next(chunks * tile_count,
                             0);  // first the number of pairs of each chunk in each tile, then where they are put
  const int useful = worthwhile(threads, count, kSplatsPerThread);
  parallel_for(int(chunks), useful, [&](int c) {
    found[c].reserve(2 * chunk);
    for (size_t i = c * chunk; i < std::min(count, (c + 1) * chunk); ++i) {
      if (i + 8 < count) __builtin_prefetch(&frame.splats[frame.visible[i + 8].splat], 1);
      Splat& splat = frame.splats[frame.visible[i].splat];
      splat.first_record = uint32_t(found[c].size());
      find_pairs(s, splat, frame.visible[i].splat, found[c]);
      splat.records = uint32_t(found[c].size()) - splat.first_record;
    }
    for (const Found& f : found[c]) ++next[c * tile_count + f.tile];
  });
  frame.tile_begin.resize(tile_count + 1);
  uint32_t total = 0;
  for (size_t t = 0; t < tile_count; ++t) {
    frame.tile_begin[t] = total;
    for (size_t c = 0; c < chunks; ++c) total += std::exchange(next[c * tile_count + t], total);
  }
  frame.tile_begin[tile_count] = total;
  frame.pairs.resize(total);
  std::vector<uint32_t> first_record(chunks, 0);
  for (size_t c = 1; c < chunks; ++c) first_record[c] = first_record[c - 1] + uint32_t(found[c - 1].size());
  parallel_for(int(chunks), useful, [&](int c) {
    for (uint32_t i = 0; i < found[c].size(); ++i) {
      const Found& f = found[c][i];
      frame.pairs[next[c * tile_count + f.tile]++] = {f.splat, first_record[c] + i, f.blocks};
    }
    for (size_t i = c * chunk; i < std::min(count, (c + 1) * chunk); ++i)
      frame.splats[frame.visible[i].splat].first_record += first_record[c];
  });
}

}  // namespace KERNEL
}  // namespace obbgs

// Which blocks of pixels a splat touches, tile by tile.
// Included once for each instruction set, by project.cpp.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "tiles.h"

namespace obbgs {
namespace KERNEL {
namespace {

// Returns a place in the image, px, rounded down; places far outside, which int could not hold, are moved closer.
inline int pixel(float place) { return int(std::min(std::max(0.0f, place), 1e6f)); }

// Appends what is found for each tile where the splat's ellipse reaches a pixel centre. A block is marked
// where the ellipse meets the rectangle of its outermost pixel centres; a vector of rows of blocks is computed at a
// time, which is those of one tile or of two.
void find_tiles(const Scene& s, const Splat& splat, uint32_t index, std::vector<Found>& found) {
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
        if (blocks[t]) found.push_back({blocks[t], first_tile + uint32_t((tile_y + t) * across + tile_x)});
    }
  }
}

}  // namespace
}  // namespace KERNEL
}  // namespace obbgs

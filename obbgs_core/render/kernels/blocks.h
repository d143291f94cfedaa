// What compositing and its gradient share: tiles, and what one splat does to one block of pixels.
// Included once for each instruction set, by composite.cpp and composite_backward.cpp.
#pragma once
#include "machine/threads.h"
#include "tiles.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr int kBlocks = 64;               // in a tile
constexpr size_t kPairsPerThread = 6000;  // with fewer, another thread takes longer to wake than it saves

struct Tile {
  int camera, x0, y0, width, height;  // pixels inside the image

  Tile(const Scene& s, int index) {
    const int across = tiles_x(s), of_camera = index % (across * tiles_y(s));
    camera = index / (across * tiles_y(s));
    x0 = of_camera % across * kTileWidth;
    y0 = of_camera / across * kTileHeight;
    width = s.width - x0 < kTileWidth ? s.width - x0 : kTileWidth;
    height = s.height - y0 < kTileHeight ? s.height - y0 : kTileHeight;
  }

  // Calls visit(x, y, pixel, block, lane) for every pixel.
  template <typename Visit>
  void for_each_pixel(const Scene& s, Visit visit) const {
    for (int y = 0; y < height; ++y) {
      const size_t row = (size_t(camera) * s.height + y0 + y) * s.width + x0;
      for (int x = 0; x < width; ++x)
        visit(x0 + x, y0 + y, row + x, (y / kBlockHeight) * 8 + x / kBlockWidth,
              (y % kBlockHeight) * kBlockWidth + x % kBlockWidth);
    }
  }
};

// Lane offsets inside a block and block offsets inside a tile, px.
struct Grid {
  vf lane_x, lane_y;
  float block_x[kBlocks], block_y[kBlocks];
  Grid() {
    for (int l = 0; l < kLanes; ++l) {
      const int column = l % kBlockWidth, row = l / kBlockWidth;
      lane_x[l] = float(column) + 0.5f;
      lane_y[l] = float(row) + 0.5f;
    }
    for (int k = 0; k < kBlocks; ++k) {
      const int column = k % 8, row = k / 8;
      block_x[k] = float(column * kBlockWidth);
      block_y[k] = float(row * kBlockHeight);
    }
  }
};

// What of a splat is constant over the blocks of a tile; u0 and v0 belong to the block at the tile's corner.
struct Brush {
  vf k1, k2, k3, level, cutoff, u0, v0;
  bool clamped;  // its alpha may reach the largest
  OBBGS_INLINE Brush(const Splat& s, const Tile& tile, const Grid& grid)
      : k1(s.k1), k2(s.k2), k3(s.k3), level(s.level), cutoff(s.cutoff), clamped(kLog2ClampedAlpha < s.level) {
    const float x = s.x - float(tile.x0), y = s.y - float(tile.y0);
    u0 = fma(k1, grid.lane_x - x, k2 * (grid.lane_y - y));
    v0 = k3 * (grid.lane_y - y);
  }
};

// What a splat does to the pixels of a block. T < 0 marks finished pixels and those outside the image.
struct Touch {
  vf u, v, alpha, weight, after;  // alpha before the clamp; after: transmittance behind the splat
  mask on;
};

OBBGS_INLINE Touch touch(const Brush& b, const Grid& grid, int k, vf T) {
  const vf u = fma(b.k1, grid.block_x[k], fma(b.k2, grid.block_y[k], b.u0));
  const vf v = fma(b.k3, grid.block_y[k], b.v0);
  const vf alpha = exp2_unbounded(minus_fma(u, u, minus_fma(v, v, b.level)));
  mask on = (b.cutoff <= alpha) & (vf(0.0f) < T);
  const vf share = b.clamped ? smaller(alpha, kMaxAlpha) : alpha;
  vf weight = zero_unless(on, share * T), after = T - weight;
  const mask stop = on & (after < vf(kMinTransmittance));
  if (__builtin_expect(any(stop), 0)) {  // these pixels end here, before this splat
    on = and_not(on, stop);
    weight = zero_unless(on, weight);
    after = select(stop, -T, after);
  }
  return {u, v, alpha, weight, after, on};
}

// Calls work<channels, features>(..., tile) for every tile of the scene.
#define OBBGS_FOR_TILES(scene, count, work, threads, ...)                                \
  const auto run = [&](auto tile_work) {                                                 \
    parallel_for(tiles(scene), worthwhile(threads, frame.pairs.size(), kPairsPerThread), \
                 [&](int tile) { tile_work(__VA_ARGS__, tile); });                       \
  };                                                                                     \
  switch (10 * scene.channels + count) {                                                 \
    case 11: run(work<1, 1>); break;                                                     \
    case 12: run(work<1, 2>); break;                                                     \
    case 33: run(work<3, 3>); break;                                                     \
    default: run(work<3, 4>); break;                                                     \
  }

}  // namespace
}  // namespace KERNEL
}  // namespace obbgs

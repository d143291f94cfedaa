// Front-to-back compositing of binned splats, one block of pixels a vector.
#include "blocks.h"

namespace obbgs {
namespace KERNEL {
namespace {

template <int C, int F>  // channels of radiance, features in all
void composite_tile(const Scene& s, Frame& frame, const Images& out, const Grid& grid, int index) {
  const Tile tile(s, index);
  const uint32_t begin = frame.tile_begin[index], end = frame.tile_begin[index + 1];
  if (begin == end) {
    tile.for_each_pixel(s, [&](int, int, size_t pixel, int, int) {
      frame.transmittance[pixel] = 1.0f;
      out.alpha[pixel] = out.depth[pixel] = out.median_depth[pixel] = 0.0f;
      for (int f = 0; f < C; ++f) out.radiance[pixel * C + f] = 0.0f;
    });
    return;
  }
  vf T[kBlocks], median[kBlocks], light[kBlocks][F];
  for (int k = 0; k < kBlocks; ++k) {
    T[k] = -1.0f;
    median[k] = 0.0f;
    for (int f = 0; f < F; ++f) light[k][f] = 0.0f;
  }
  tile.for_each_pixel(s, [&](int, int, size_t, int k, int lane) { T[k][lane] = 1.0f; });
  uint64_t open = ~0ull;
  for (uint32_t p = begin; p < end; ++p) {
    Pair& pair = frame.pairs[p];
    if (p + 4 < end) __builtin_prefetch(&frame.splats[frame.pairs[p + 4].splat]);
    const Splat& splat = frame.splats[pair.splat];
    const Brush brush(splat, tile, grid);
    vf feature[F];
    for (int f = 0; f < F; ++f) feature[f] = splat.feature[f];
    const vf depth = splat.feature[C];
    uint64_t lit = 0;
    for (uint64_t left = pair.blocks & open; left; left &= left - 1) {
      const int k = __builtin_ctzll(left);
      const Touch t = touch(brush, grid, k, T[k]);
      lit |= uint64_t(any(t.on)) << k;
      for (int f = 0; f < F; ++f) light[k][f] = multiply_add(t.weight, feature[f], light[k][f]);
      median[k] = select((t.after <= vf(0.5f)) & (vf(0.5f) < T[k]), depth, median[k]);
      T[k] = t.after;
      if (all_negative(t.after)) open &= ~(1ull << k);
    }
    pair.blocks = lit;
  }
  const float* lanes = reinterpret_cast<const float*>(light);
  tile.for_each_pixel(s, [&](int, int, size_t pixel, int k, int lane) {
    const float transmittance = __builtin_fabsf(T[k][lane]), alpha = 1.0f - transmittance;
    const auto value = [&](int f) { return lanes[(k * F + f) * kLanes + lane]; };
    frame.transmittance[pixel] = transmittance;
    out.alpha[pixel] = alpha;
    for (int f = 0; f < C; ++f) out.radiance[pixel * C + f] = value(f);
    out.depth[pixel] = alpha > kMinDepthAlpha ? value(C) / alpha : 0.0f;
    out.median_depth[pixel] = median[k][lane];
  });
}

}  // namespace

void composite(const Scene& s, Frame& frame, const Images& out, int threads) {
  const Grid grid;
  frame.transmittance.resize(size_t(s.cameras) * s.width * s.height);
  OBBGS_FOR_TILES(s, s.channels + 1, composite_tile, threads, s, frame, out, grid)
}

}  // namespace KERNEL
}  // namespace obbgs

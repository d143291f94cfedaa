// Front-to-back compositing of binned splats and its analytic gradient, one 4x4 block a vector.
#include "rasterizer.h"
#include "simd.h"
#include "threads.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr int kBlocks = 64;  // blocks of a tile

struct Tile {
  int camera, x0, y0, width, height;  // pixels inside the image

  Tile(const Scene& s, int index) {
    const int tiles_x = s.tiles_x(), of_camera = index % (tiles_x * s.tiles_y());
    camera = index / (tiles_x * s.tiles_y());
    x0 = of_camera % tiles_x * kTile;
    y0 = of_camera / tiles_x * kTile;
    width = s.width - x0 < kTile ? s.width - x0 : kTile;
    height = s.height - y0 < kTile ? s.height - y0 : kTile;
  }

  // Calls visit(x, y, pixel, block, lane) for every pixel.
  template <typename Visit>
  void for_each_pixel(const Scene& s, Visit visit) const {
    for (int y = 0; y < height; ++y) {
      const size_t row = (size_t(camera) * s.height + y0 + y) * s.width + x0;
      for (int x = 0; x < width; ++x)
        visit(x0 + x, y0 + y, row + x, (y / kBlock) * 8 + x / kBlock, (y % kBlock) * kBlock + x % kBlock);
    }
  }
};

// Lane offsets inside a block and block offsets inside a tile, px.
struct Grid {
  vf lane_x, lane_y;
  float block_x[kBlocks], block_y[kBlocks];
  Grid() {
    for (int l = 0; l < kLanes; ++l) {
      lane_x[l] = float(l % kBlock) + 0.5f;
      lane_y[l] = float(l / kBlock) + 0.5f;
    }
    for (int k = 0; k < kBlocks; ++k) {
      block_x[k] = float(k % 8 * kBlock);
      block_y[k] = float(k / 8 * kBlock);
    }
  }
};

// A splat as seen from a tile: what is constant over its blocks.
struct Brush {
  vf k1, k2, k3, level, u0, v0;
  OBBGS_INLINE Brush(const Splat& s, const Tile& tile, const Grid& grid) : k1(s.k1), k2(s.k2), k3(s.k3), level(s.level) {
    const float x = s.x - float(tile.x0), y = s.y - float(tile.y0);
    u0 = fma(k1, grid.lane_x - x, k2 * (grid.lane_y - y));
    v0 = k3 * (grid.lane_y - y);
  }
};

// What a splat does to a block. T < 0 marks finished pixels and those outside the image.
struct Touch {
  vf u, v, alpha, weight, after;  // alpha before the clamp; after: transmittance behind the splat
  mask on;
};

OBBGS_INLINE Touch touch(const Brush& b, const Grid& grid, int k, vf T) {
  const vf u = fma(b.k1, grid.block_x[k], fma(b.k2, grid.block_y[k], b.u0));
  const vf v = fma(b.k3, grid.block_y[k], b.v0);
  const vf alpha = exp2_unbounded(minus_fma(u, u, minus_fma(v, v, b.level)));
  mask on = (vf(kMinAlpha) <= alpha) & (vf(0.0f) < T);
  vf weight = zero_unless(on, smaller(alpha, kMaxAlpha) * T), after = T - weight;
  const mask stop = on & (after < vf(kMinTransmittance));
  if (__builtin_expect(any(stop), 0)) {  // these pixels end here, before this splat
    on = and_not(on, stop);
    weight = zero_unless(on, weight);
    after = select(stop, -T, after);
  }
  return {u, v, alpha, weight, after, on};
}

template <int C, int F>  // channels of radiance, features in all
void composite_tile(const Scene& s, Frame& frame, const Images& out, const Grid& grid, int index) {
  const Tile tile(s, index);
  const uint32_t begin = frame.tile_begin[index], end = frame.tile_begin[index + 1];
  if (begin == end) {
    tile.for_each_pixel(s, [&](int, int, size_t pixel, int, int) {
      frame.transmittance[pixel] = 1.0f;
      out.alpha[pixel] = out.depth[pixel] = out.median_depth[pixel] = 0.0f;
      for (int f = 0; f < C; ++f) out.radiance[pixel * C + f] = 0.0f;
      if (out.normals)
        for (int f = 0; f < 3; ++f) out.normals[pixel * 3 + f] = 0.0f;
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
      if (!any(vf(0.0f) < t.after)) open &= ~(1ull << k);
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
    if (out.normals)
      for (int f = 0; f < 3; ++f) out.normals[pixel * 3 + f] = value(C + 1 + f);
  });
}

// record[slot(i)] = the sum of all lanes of sums[i].
template <int N>
OBBGS_INLINE void store_sums(const vf (&sums)[N], float* record) {
#if defined(__AVX512F__)
  // Adds while transposing: sixteen vectors in four rounds.
  __m512 v[16], half[8], quarter[4];
  for (int i = 0; i < 16; ++i) v[i] = i < N ? sums[i].part[0] : _mm512_setzero_ps();
  for (int i = 0; i < 8; ++i)
    half[i] = _mm512_add_ps(_mm512_shuffle_f32x4(v[2 * i], v[2 * i + 1], 0x44), _mm512_shuffle_f32x4(v[2 * i], v[2 * i + 1], 0xEE));
  for (int i = 0; i < 4; ++i)
    quarter[i] = _mm512_add_ps(_mm512_shuffle_f32x4(half[2 * i], half[2 * i + 1], 0x88), _mm512_shuffle_f32x4(half[2 * i], half[2 * i + 1], 0xDD));
  const auto add = [](__m512 a, __m512 b) { return _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b)); };
  const __m512d low = _mm512_castps_pd(add(quarter[0], quarter[1])), high = _mm512_castps_pd(add(quarter[2], quarter[3]));
  _mm512_store_ps(record, _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(low, high)), _mm512_castpd_ps(_mm512_unpackhi_pd(low, high))));
#else
  for (int i = 0; i < N; ++i) record[slot(i)] = sum(sums[i]);
#endif
}

template <int C, int F>
void composite_backward_tile(const Scene& s, const Frame& frame, const Images& out, const ImageGradients& g, float* records,
                             const Grid& grid, int index) {
  const Tile tile(s, index);
  const uint32_t begin = frame.tile_begin[index], end = frame.tile_begin[index + 1];
  if (begin == end) return;
  // behind: the loss's first-order share of all light still to come, gradient . (light behind, final transmittance)
  vf T[kBlocks], behind[kBlocks], grad[kBlocks][F];
  for (int k = 0; k < kBlocks; ++k) {
    T[k] = -1.0f;
    behind[k] = 0.0f;
    for (int f = 0; f < F; ++f) grad[k][f] = 0.0f;
  }
  float* lanes = reinterpret_cast<float*>(grad);
  tile.for_each_pixel(s, [&](int x, int y, size_t pixel, int k, int lane) {
    const float transmittance = frame.transmittance[pixel], alpha = 1.0f - transmittance;
    float grad_alpha = g.alpha.at(tile.camera, y, x, 0), total = 0.0f;
    const auto add = [&](int f, float gradient, float value) {
      lanes[(k * F + f) * kLanes + lane] = gradient;
      total += gradient * value;
    };
    for (int f = 0; f < C; ++f) add(f, g.radiance.at(tile.camera, y, x, f), out.radiance[pixel * C + f]);
    if (F > C && alpha > kMinDepthAlpha) {
      const float depth = out.depth[pixel], grad_depth = g.depth.at(tile.camera, y, x, 0) / alpha;
      add(C, grad_depth, depth * alpha);
      grad_alpha -= grad_depth * depth;
    }
    for (int f = C + 1; f < F; ++f) {
      const int axis = f - C - 1;
      add(f, g.normals.at(tile.camera, y, x, axis), out.normals[pixel * 3 + axis]);
    }
    T[k][lane] = 1.0f;
    behind[k][lane] = total - grad_alpha * transmittance;
  });
  for (uint32_t p = begin; p < end; ++p) {
    const Pair& pair = frame.pairs[p];
    float* record = records + size_t(pair.record) * kRecord;
    if (!pair.blocks) {
      std::memset(record, 0, kRecord * sizeof(float));
      continue;
    }
    if (p + 4 < end) __builtin_prefetch(&frame.splats[frame.pairs[p + 4].splat]);
    const Splat& splat = frame.splats[pair.splat];
    const Brush brush(splat, tile, grid);
    vf feature[F], sums[kFirstFeature + F];
    for (int f = 0; f < F; ++f) feature[f] = splat.feature[f];
    for (vf& total : sums) total = 0.0f;
    int pixels = 0;
    for (uint64_t left = pair.blocks; left; left &= left - 1) {
      const int k = __builtin_ctzll(left);
      const Touch t = touch(brush, grid, k, T[k]);
      vf dot = grad[k][0] * feature[0];
      for (int f = 1; f < F; ++f) dot = multiply_add(grad[k][f], feature[f], dot);
      const vf share = t.weight * dot;
      behind[k] = behind[k] - share;
      // dL/dalpha * alpha; a clamped alpha passes no gradient to the Gaussian's shape
      const vf slope = zero_unless(t.alpha < vf(kMaxAlpha), share - behind[k] * (t.weight * reciprocal(t.after)));
      const vf slope_u = slope * t.u, slope_v = slope * t.v;
      sums[kG] = sums[kG] + slope;
      sums[kGU] = sums[kGU] + slope_u;
      sums[kGV] = sums[kGV] + slope_v;
      sums[kGUU] = multiply_add(slope_u, t.u, sums[kGUU]);
      sums[kGUV] = multiply_add(slope_u, t.v, sums[kGUV]);
      sums[kGVV] = multiply_add(slope_v, t.v, sums[kGVV]);
      for (int f = 0; f < F; ++f) sums[kFirstFeature + f] = multiply_add(grad[k][f], t.weight, sums[kFirstFeature + f]);
      pixels += count(t.on);
      T[k] = t.after;
    }
    store_sums(sums, record);
    record[kPixels] = float(pixels);
  }
}

}  // namespace

constexpr size_t kGrain = 6000;  // pairs that are worth a thread

// Calls work<channels, features>(..., tile) for every tile.
#define OBBGS_FOR_TILES(scene, count, work, threads, ...)                                                              \
  const auto run = [&](auto tile_work) {                                                                               \
    parallel_for(scene.tiles(), worthwhile(threads, frame.pairs.size(), kGrain), [&](int tile) { tile_work(__VA_ARGS__, tile); }); \
  };                                                                                                                   \
  switch (10 * scene.channels + count) {                                                                               \
    case 11: run(work<1, 1>); break;                                                                                   \
    case 12: run(work<1, 2>); break;                                                                                   \
    case 15: run(work<1, 5>); break;                                                                                   \
    case 33: run(work<3, 3>); break;                                                                                   \
    case 34: run(work<3, 4>); break;                                                                                   \
    default: run(work<3, 7>); break;                                                                                   \
  }

void composite(const Scene& s, Frame& frame, const Images& out, int threads) {
  const Grid grid;
  frame.transmittance.resize(size_t(s.cameras) * s.width * s.height);
  OBBGS_FOR_TILES(s, s.features(), composite_tile, threads, s, frame, out, grid)
}

void composite_backward(const Scene& s, const Frame& frame, const Images& out, const ImageGradients& g, float* records, int threads) {
  const Grid grid;
  OBBGS_FOR_TILES(s, g.features(s), composite_backward_tile, threads, s, frame, out, g, records, grid)
}

}  // namespace KERNEL
}  // namespace obbgs

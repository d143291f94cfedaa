// The gradient of compositing, front to back like compositing itself, one block of pixels a vector.
#include "blocks.h"

namespace obbgs {
namespace KERNEL {
namespace {

// The state of a tile's pixels, by block, while its splats are taken front to back.
template <int F>
struct PixelGradients {
  vf T[kBlocks];        // transmittance; negative for finished pixels and those outside the image
  vf behind[kBlocks];   // grad . features of all light behind the current splat, less the part of the final
                        // transmittance
  vf grad[kBlocks][F];  // of the loss by the composited features
};

template <int C, int F>
OBBGS_INLINE void load_gradients(const Scene& s, const Frame& frame, const Images& out, const ImageGradients& g,
                                 const Tile& tile, PixelGradients<F>& pixels) {
  auto &T = pixels.T, &behind = pixels.behind;
  auto& grad = pixels.grad;
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
    T[k][lane] = 1.0f;
    behind[k][lane] = total - grad_alpha * transmittance;
  });
}

template <int C, int F>
void composite_backward_tile(const Scene& s, const Frame& frame, const Images& out, const ImageGradients& g,
                             float* records, const Grid& grid, int index) {
  const Tile tile(s, index);
  const uint32_t begin = frame.tile_begin[index], end = frame.tile_begin[index + 1];
  if (begin == end) return;
  PixelGradients<F> pixels;
  load_gradients<C>(s, frame, out, g, tile, pixels);
  auto &T = pixels.T, &behind = pixels.behind;
  auto& grad = pixels.grad;
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
    for (uint64_t left = pair.blocks; left; left &= left - 1) {
      const int k = __builtin_ctzll(left);
      const Touch t = touch(brush, grid, k, T[k]);
      vf dot = grad[k][0] * feature[0];
      for (int f = 1; f < F; ++f) dot = multiply_add(grad[k][f], feature[f], dot);
      const vf share = t.weight * dot;
      behind[k] = behind[k] - share;
      // d loss / d alpha * alpha; where alpha is clamped, the Gaussian's shape has no gradient
      vf slope = share - behind[k] * (t.weight * reciprocal(t.after));
      if (brush.clamped) slope = zero_unless(t.alpha < vf(kMaxAlpha), slope);
      const vf slope_u = slope * t.u, slope_v = slope * t.v;
      sums[kG] = sums[kG] + slope;
      sums[kGU] = sums[kGU] + slope_u;
      sums[kGV] = sums[kGV] + slope_v;
      sums[kGUU] = multiply_add(slope_u, t.u, sums[kGUU]);
      sums[kGUV] = multiply_add(slope_u, t.v, sums[kGUV]);
      sums[kGVV] = multiply_add(slope_v, t.v, sums[kGVV]);
      for (int f = 0; f < F; ++f) sums[kFirstFeature + f] = multiply_add(grad[k][f], t.weight, sums[kFirstFeature + f]);
      sums[kPixels] = sums[kPixels] + zero_unless(t.on, 1.0f);
      T[k] = t.after;
    }
    add_lanes(sums, record);
  }
}

}  // namespace

void composite_backward(const Scene& s, const Frame& frame, const Images& out, const ImageGradients& g, float* records,
                        int threads) {
  const Grid grid;
  OBBGS_FOR_TILES(s, g.features(s), composite_backward_tile, threads, s, frame, out, g, records, grid)
}

}  // namespace KERNEL
}  // namespace obbgs

// Front-to-back compositing of binned Gaussians and its analytic gradient, one 4x4 block a vector.
// Compiled once for each instruction set (KERNEL names the namespace); plain GCC vector types throughout.
#include <cstring>
#include <vector>

#include "rasterizer.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr int kLanes = kBlock * kBlock;
typedef float vf __attribute__((vector_size(4 * kLanes)));
typedef int32_t vi __attribute__((vector_size(4 * kLanes)));

inline vf splat_of(float x) { return x - vf{}; }

// exp(x) for x <= 0, relative error 2e-7; below -60 the result is irrelevant (alpha is cut at 1/255).
inline vf exp_negative(vf x) {
  x = x < -60.0f ? splat_of(-60.0f) : x;
  const vf t = x * 1.44269504f;
  const vi n = __builtin_convertvector(t - 0.5f, vi);  // truncation towards zero of a negative number rounds it
  const vf f = (t - __builtin_convertvector(n, vf)) * 0.693147181f;
  vf p = f * 1.3888889e-3f + 8.3333333e-3f;
  p = p * f + 4.1666667e-2f;
  p = p * f + 1.6666667e-1f;
  p = p * f + 0.5f;
  p = p * f + 1.0f;
  p = p * f + 1.0f;
  const vi bits = (n + 127) << 23;
  vf scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return p * scale;
}

inline float sum(vf v) {
  float total = 0;
  for (int i = 0; i < kLanes; ++i) total += v[i];
  return total;
}

inline bool any(vi mask) {
  int32_t all = 0;
  for (int i = 0; i < kLanes; ++i) all |= mask[i];
  return all != 0;
}

struct Lanes { vf x, y; };
inline Lanes block_offsets() {
  Lanes lanes;
  for (int i = 0; i < kLanes; ++i) { lanes.x[i] = (i % kBlock) + 0.5f; lanes.y[i] = (i / kBlock) + 0.5f; }
  return lanes;
}

// What one Gaussian does to one block.
struct Touch { vf dx, dy, falloff, alpha; vi on, stop; };

inline Touch touch(const Splats& s, uint32_t i, vf px, vf py, vf T, vi alive) {
  Touch t;
  t.dx = px - s.means2d[2 * i];
  t.dy = py - s.means2d[2 * i + 1];
  const float a = s.conics[3 * i], b = s.conics[3 * i + 1], c = s.conics[3 * i + 2];
  const vf power = -0.5f * (a * t.dx * t.dx + c * t.dy * t.dy) - b * t.dx * t.dy;
  t.falloff = exp_negative(power > 0.0f ? vf{} : power);
  t.alpha = s.opacities[i] * t.falloff;
  t.alpha = t.alpha > kMaxAlpha ? splat_of(kMaxAlpha) : t.alpha;
  t.on = (t.alpha >= kMinAlpha) & alive;
  t.stop = t.on & (T * (1.0f - t.alpha) < kMinTransmittance);
  t.on &= ~t.stop;
  return t;
}

// Copies a [height, width, n] image into or out of a tile's blocks, lane by lane, inside the image only.
template <typename Visit>
inline void for_each_pixel(const Bins& bins, int tile, Visit visit) {
  const int x0 = tile % bins.tiles_x * kTile, y0 = tile / bins.tiles_x * kTile;
  const int w = bins.width - x0 < kTile ? bins.width - x0 : kTile, h = bins.height - y0 < kTile ? bins.height - y0 : kTile;
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x)
      visit(size_t(y0 + y) * bins.width + x0 + x, (y / kBlock) * 8 + x / kBlock, (y % kBlock) * kBlock + x % kBlock);
}

template <int F>
void forward_tile(const Bins& bins, const Splats& s, const float* features, const Images& out, int tile) {
  const uint32_t begin = bins.tile_begin[tile], end = bins.tile_begin[tile + 1];
  if (begin == end) return;  // outputs start as an empty sky
  alignas(64) vf T[64], median[64], acc[64][F];
  alignas(64) vi alive[64];
  for (int k = 0; k < 64; ++k) {
    T[k] = splat_of(1.0f);
    median[k] = vf{};
    alive[k] = vi{};
    for (int f = 0; f < F; ++f) acc[k][f] = vf{};
  }
  for_each_pixel(bins, tile, [&](size_t, int k, int lane) { alive[k][lane] = -1; });
  const Lanes lanes = block_offsets();
  const float x0 = float(tile % bins.tiles_x * kTile), y0 = float(tile / bins.tiles_x * kTile);
  uint64_t open = ~0ull;
  for (uint32_t p = begin; p < end && open; ++p) {
    const uint32_t i = bins.pairs[p].splat;
    const float* feature = features + size_t(i) * F;
    for (uint64_t left = bins.pairs[p].blocks & open; left; left &= left - 1) {
      const int k = __builtin_ctzll(left);
      const Touch t = touch(s, i, lanes.x + (x0 + (k & 7) * kBlock), lanes.y + (y0 + (k >> 3) * kBlock), T[k], alive[k]);
      const vf w = t.on ? t.alpha * T[k] : vf{};
      for (int f = 0; f < F; ++f) acc[k][f] += w * feature[f];
      const vf after = T[k] - w;
      median[k] = ((T[k] > 0.5f) & (after <= 0.5f)) ? splat_of(s.depths[i]) : median[k];
      T[k] = after;
      if (any(t.stop)) {
        alive[k] &= ~t.stop;
        if (!any(alive[k])) open &= ~(1ull << k);
      }
    }
  }
  for_each_pixel(bins, tile, [&](size_t pixel, int k, int lane) {
    out.transmittance[pixel] = T[k][lane];
    out.median_depth[pixel] = median[k][lane];
    for (int f = 0; f < F; ++f) out.features[pixel * F + f] = acc[k][f][lane];
  });
}

template <int F>
void backward_tile(const Bins& bins, const Splats& s, const float* features, const Images& out, const Gradients& g,
                   int tile, float* records) {
  constexpr int R = 7 + F;  // a record: mean 2, conic 3, opacity 1, pixels 1, features F
  const uint32_t begin = bins.tile_begin[tile], end = bins.tile_begin[tile + 1];
  if (begin == end) return;
  alignas(64) vf T[64], rest[64][F], grad[64][F], grad_T[64];  // rest: colour still to come from behind
  alignas(64) vi alive[64];
  std::memset(alive, 0, sizeof alive);
  std::memset(grad, 0, sizeof grad);
  std::memset(grad_T, 0, sizeof grad_T);
  std::memset(rest, 0, sizeof rest);
  for (int k = 0; k < 64; ++k) T[k] = splat_of(1.0f);
  for_each_pixel(bins, tile, [&](size_t pixel, int k, int lane) {
    alive[k][lane] = -1;
    grad_T[k][lane] = g.transmittance[pixel] * out.transmittance[pixel];
    for (int f = 0; f < F; ++f) {
      rest[k][f][lane] = out.features[pixel * F + f];
      grad[k][f][lane] = g.features[pixel * F + f];
    }
  });
  const Lanes lanes = block_offsets();
  const float x0 = float(tile % bins.tiles_x * kTile), y0 = float(tile / bins.tiles_x * kTile);
  uint64_t open = ~0ull;
  for (uint32_t p = begin; p < end && open; ++p) {
    const uint32_t i = bins.pairs[p].splat;
    const float* feature = features + size_t(i) * F;
    const float a = s.conics[3 * i], b = s.conics[3 * i + 1], c = s.conics[3 * i + 2];
    vf g_x{}, g_y{}, g_a{}, g_b{}, g_c{}, g_o{}, touched{}, g_f[F];
    for (int f = 0; f < F; ++f) g_f[f] = vf{};
    for (uint64_t left = bins.pairs[p].blocks & open; left; left &= left - 1) {
      const int k = __builtin_ctzll(left);
      const Touch t = touch(s, i, lanes.x + (x0 + (k & 7) * kBlock), lanes.y + (y0 + (k >> 3) * kBlock), T[k], alive[k]);
      const vf w = t.on ? t.alpha * T[k] : vf{};
      const vf inverse = 1.0f / (1.0f - t.alpha);
      vf g_alpha = -grad_T[k] * inverse;
      for (int f = 0; f < F; ++f) {
        g_f[f] += grad[k][f] * w;
        rest[k][f] -= w * feature[f];
        g_alpha += grad[k][f] * (T[k] * feature[f] - rest[k][f] * inverse);
      }
      // a clamped alpha passes no gradient to the Gaussian's shape
      g_alpha = (t.on & (t.alpha < kMaxAlpha)) ? g_alpha : vf{};
      const vf g_power = g_alpha * t.alpha;
      g_o += g_alpha * t.falloff;
      g_x += g_power * (a * t.dx + b * t.dy);
      g_y += g_power * (b * t.dx + c * t.dy);
      g_a -= 0.5f * g_power * t.dx * t.dx;
      g_b -= g_power * t.dx * t.dy;
      g_c -= 0.5f * g_power * t.dy * t.dy;
      touched += t.on ? splat_of(1.0f) : vf{};
      T[k] -= w;
      if (any(t.stop)) {
        alive[k] &= ~t.stop;
        if (!any(alive[k])) open &= ~(1ull << k);
      }
    }
    float* record = records + size_t(bins.pairs[p].record) * R;
    record[0] = sum(g_x);
    record[1] = sum(g_y);
    record[2] = sum(g_a);
    record[3] = sum(g_b);
    record[4] = sum(g_c);
    record[5] = sum(g_o);
    record[6] = sum(touched);
    for (int f = 0; f < F; ++f) record[7 + f] = sum(g_f[f]);
  }
}

template <int F>
void backward_all(const Bins& bins, const Splats& s, const float* features, const Images& out, const Gradients& g, int threads) {
  constexpr int R = 7 + F;
  std::vector<float> records(bins.pairs.size() * R, 0.0f);
  for_each_tile(bins.tiles_x * bins.tiles_y, threads,
                [&](int tile) { backward_tile<F>(bins, s, features, out, g, tile, records.data()); });
  for (int i = 0; i < s.count; ++i) {  // a fixed order of sums: the same result on every run
    float total[R] = {};
    for (uint32_t r = bins.splat_begin[i]; r < bins.splat_begin[i + 1]; ++r)
      for (int k = 0; k < R; ++k) total[k] += records[size_t(r) * R + k];
    std::memcpy(g.means2d + 2 * i, total, 2 * sizeof(float));
    std::memcpy(g.conics + 3 * i, total + 2, 3 * sizeof(float));
    g.opacities[i] = total[5];
    g.pixels[i] = total[6];
    std::memcpy(g.splat_features + size_t(i) * F, total + 7, F * sizeof(float));
  }
}

}  // namespace

#define OBBGS_FOR_FEATURES(call) \
  switch (count) {               \
    case 1: call(1); break;      \
    case 2: call(2); break;      \
    case 3: call(3); break;      \
    case 4: call(4); break;      \
    case 5: call(5); break;      \
    case 6: call(6); break;      \
    case 7: call(7); break;      \
    default: call(8); break;     \
  }

void forward(const Bins& bins, const Splats& s, const float* features, int count, const Images& out, int threads) {
#define OBBGS_FORWARD(F) \
  for_each_tile(bins.tiles_x * bins.tiles_y, threads, [&](int tile) { forward_tile<F>(bins, s, features, out, tile); })
  OBBGS_FOR_FEATURES(OBBGS_FORWARD)
}

void backward(const Bins& bins, const Splats& s, const float* features, int count, const Images& out,
              const Gradients& g, int threads) {
#define OBBGS_BACKWARD(F) backward_all<F>(bins, s, features, out, g, threads)
  OBBGS_FOR_FEATURES(OBBGS_BACKWARD)
}

}  // namespace KERNEL
}  // namespace obbgs

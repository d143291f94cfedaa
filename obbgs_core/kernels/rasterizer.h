// The CPU rasterizer: which 4x4 pixel blocks each projected Gaussian touches (bins), and compositing over them.
#pragma once
#include <atomic>
#include <cstdint>
#include <functional>
#include <vector>

namespace obbgs {

constexpr int kBlock = 4;                 // pixels along a block's side: one 16-lane vector a block
constexpr int kTile = 32;                 // pixels along a tile's side: 8x8 blocks, one 64-bit mask
constexpr float kMinAlpha = 1.0f / 255;   // fainter contributions are skipped
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;  // a pixel is finished before it falls below
constexpr int kMaxFeatures = 8;

// Projected Gaussians; conics are (xx, xy, yy) of the inverse 2D covariance, px^-2.
struct Splats {
  int count;
  const float *means2d, *conics, *opacities, *depths;
};

// One Gaussian in one tile. Pairs of a Gaussian are contiguous before binning, so `record` orders its gradients.
struct Pair {
  uint32_t splat, record;
  uint64_t blocks;  // bit 8*row+column: the Gaussian reaches alpha >= kMinAlpha somewhere in that block's rows
};

struct Bins {
  int width, height, tiles_x, tiles_y;
  std::vector<Pair> pairs;             // by tile, then by depth
  std::vector<uint32_t> tile_begin;    // [tiles + 1]
  std::vector<uint32_t> splat_begin;   // records of splat i: splat_begin[i] .. splat_begin[i + 1]
};

Bins bin(const Splats& splats, int width, int height);

struct Images {  // [height, width, features], [height, width], [height, width]
  float *features, *transmittance, *median_depth;
};

struct Gradients {  // of the loss, per pixel in and per Gaussian out
  const float *features, *transmittance;
  float *means2d, *conics, *opacities, *splat_features;
  float *pixels;  // [count] pixels that each Gaussian touched
};

// Runs work(tile) for all tiles on up to `threads` threads; tiles are handed out one by one.
void for_each_tile(int tiles, int threads, const std::function<void(int)>& work);

#define OBBGS_DECLARE_KERNEL(name)                                                                             \
  namespace name {                                                                                             \
  void forward(const Bins&, const Splats&, const float* features, int feature_count, const Images&, int threads); \
  void backward(const Bins&, const Splats&, const float* features, int feature_count, const Images&,            \
                const Gradients&, int threads);                                                                \
  }
OBBGS_DECLARE_KERNEL(portable)
OBBGS_DECLARE_KERNEL(avx2)
OBBGS_DECLARE_KERNEL(avx512)

}  // namespace obbgs

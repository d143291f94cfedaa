// The CPU rasterizer: projection (project.cpp), which blocks of pixels each Gaussian touches (bins.cpp), compositing
// over them (composite.cpp), and the gradient (composite_backward.cpp, project_backward.cpp). These are compiled once
// for each instruction set; binding.cpp picks one at run time.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

namespace obbgs {

// Python has the same numbers; binding.cpp shows these to the test that compares them. Source: Kerbl et al. 2023.
constexpr float kMinAlpha = 1.0f / 255;        // fainter contributions are skipped; lowered with a peak
constexpr float kLog2MinAlpha = -7.99435344f;  // log2(kMinAlpha)
constexpr float kMaxAlpha = 0.99f;
constexpr float kLog2ClampedAlpha = -0.015f;  // below log2(kMaxAlpha): a level up to this is never clamped
constexpr float kMinTransmittance = 1e-4f;    // a pixel is finished before its transmittance would fall below
constexpr float kMinPeakShare = 1.0f / 4096;  // a Gaussian whose peak falls to less of its opacity is not drawn
constexpr float kMinDepthAlpha = 1e-6f;       // the depth is 0 where alpha is not above this
constexpr float kFovMargin = 1.3f;            // the affine approximation is clamped this far outside the image
constexpr float kSoftness = 10.0f;            // radiance = softplus(kSoftness x) / kSoftness

constexpr int kMaxChannels = 3, kMaxCoefficients = 16;
constexpr int kMaxFeatures = kMaxChannels + 1;  // radiance, depth
constexpr int kRecord = 16;                     // floats of a gradient record: one cache line

// The model and the cameras, row-major float32 as in Gaussians and Cameras.
struct Scene {
  int gaussians, cameras, sh_count, channels, width, height;
  float near_m;
  const float *means, *quats, *log_scales, *opacity_logits, *sh, *world_to_camera, *K;
  const float* sun_dir;  // [cameras, 3] direction at which the harmonics are evaluated; null: the viewing direction
  const float* sunlit;  // [cameras, gaussians] visibility of the Sun; sh is then an albedo under Lambert's law; or null
  float ambient;        // added to the Sun's light on every side
  const float* added;   // [cameras, gaussians, channels] radiance that is added to what the harmonics say; or null
  const float* footprint_px2;  // [cameras] variance of what a pixel averages over, added to the 2D covariance
  bool peak_lowered;           // so that the added variance leaves a Gaussian's light as it is
};

// One Gaussian in one camera. At offset d px from (x, y): alpha = 2^(level - u^2 - v^2), u = k1 dx + k2 dy, v = k3 dy,
// which is the Cholesky factor of the conic; 2^level is the opacity, lowered as the footprint wants. Where alpha is
// below `cutoff`, which is where u^2 + v^2 is above `reach`, nothing is drawn.
struct alignas(64) Splat {
  float x, y, k1, k2, k3, level, cutoff, reach;
  float feature[kMaxFeatures];
  // its gradient records, one for each tile it touches, from the first of its chunk on; none if it is not drawn
  uint32_t first_record, records;
};

// One splat in one tile.
struct Pair {
  uint32_t splat, record;
  uint64_t blocks;  // bit 8*row + column; compositing leaves only the blocks that received light
};

template <typename T>
class Buffer {  // a resizable array; resizing leaves it uninitialised
 public:
  void resize(size_t size) {
    data_.reset(new T[size]);
    size_ = size;
  }
  T* data() { return data_.get(); }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }
  size_t size() const { return size_; }
  size_t bytes() const { return size_ * sizeof(T); }

 private:
  std::unique_ptr<T[]> data_;
  size_t size_ = 0;
};

// A tile that a splat touches, and which blocks of it.
struct Found {
  uint64_t blocks;
  uint32_t tile;
};

struct DepthKey {
  uint32_t depth_bits, splat;
};

// Gaussians in a unit of parallel work: a constant, so that sums are added in the same order with any number of threads
constexpr int kChunk = 256;

// What the forward pass leaves for the backward pass.
struct Frame {
  Buffer<Splat> splats;      // [cameras * gaussians]
  Buffer<DepthKey> visible;  // splats on an image, nearest first once binned
  size_t visible_count = 0;
  std::vector<std::vector<Found>> found;  // of each chunk of Gaussians, splat by splat; empty once binned
  std::vector<uint32_t> first_record;     // of each chunk
  Buffer<uint32_t> tile_begin;            // [tiles + 1] into pairs
  Buffer<Pair> pairs;                     // by tile, then by depth
  Buffer<float> transmittance;            // [cameras, height, width]
};

struct Images {  // [cameras, height, width] and, for radiance, channels
  float *radiance, *alpha, *depth, *median_depth;
};

// Gradient of an image with its strides in floats (camera, row, column, channel); zero if the loss does not depend on
// it.
struct ImageGradient {
  static constexpr float kZero = 0.0f;
  const float* data = &kZero;
  int64_t stride[4] = {};
  bool given() const { return data != &kZero; }
  float at(int camera, int y, int x, int channel) const {
    return data[camera * stride[0] + y * stride[1] + x * stride[2] + channel * stride[3]];
  }
};

struct ImageGradients {
  ImageGradient radiance, alpha, depth;
  int features(const Scene& s) const { return s.channels + depth.given(); }  // those that the loss depends on
};

struct SceneGradients {
  const float* means2d_in;  // [cameras, gaussians, 2] gradient of the projected means from elsewhere, or null
  float *means, *quats, *log_scales, *opacity_logits, *sh, *world_to_camera, *ambient, *footprint_px2;
  float* added;             // [cameras, gaussians, channels], or null
  float *means2d, *pixels;  // [cameras, gaussians, 2] loss per px, [cameras, gaussians] pixels touched
};

// Sums over one splat's pixels in one tile: g = dL/dalpha * alpha, their number, its features' gradients; `slot` in
// simd.h is where in the record each lies.
enum Sum { kG, kGU, kGV, kGUU, kGUV, kGVV, kPixels, kFirstFeature };
static_assert(kFirstFeature + kMaxFeatures <= kRecord, "every sum has its place");

#define OBBGS_DECLARE_KERNEL(name)                                                                             \
  namespace name {                                                                                             \
  void project(const Scene&, Frame&, float* means2d, float* radii, int threads);                               \
  void bin(const Scene&, Frame&, int threads);                                                                 \
  void composite(const Scene&, Frame&, const Images&, int threads);                                            \
  void composite_backward(const Scene&, const Frame&, const Images&, const ImageGradients&, float* records,    \
                          int threads);                                                                        \
  void project_backward(const Scene&, const Frame&, const float* records, int features, const SceneGradients&, \
                        int threads);                                                                          \
  }
OBBGS_DECLARE_KERNEL(portable)
OBBGS_DECLARE_KERNEL(avx2)
OBBGS_DECLARE_KERNEL(avx512)

}  // namespace obbgs

// A vector of Gaussians at a time: their parameters, and their affine (EWA) projection into one camera.
// Included once for each instruction set, by project.cpp and project_backward.cpp.
#pragma once
#include <algorithm>
#include <cfloat>

#include "machine/simd.h"
#include "rasterizer.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr size_t kSplatsPerThread = 1024;  // with fewer, another thread takes longer to wake than it saves
constexpr float kMinNorm = 1e-12f;

inline mask finite(vf x) { return absolute(x) <= vf(FLT_MAX); }
inline vf dot(const vf* a, const vf* b) { return fma(a[2], b[2], fma(a[1], b[1], a[0] * b[0])); }

// As many Gaussians as a vector has lanes, from `first` on; beyond the end the last one is repeated.
struct Group {
  int first, size, index[kLanes];

  Group(const Scene& s, int first) : first(first), size(s.gaussians - first < kLanes ? s.gaussians - first : kLanes) {
    for (int l = 0; l < kLanes; ++l) index[l] = first + (l < size ? l : size - 1);
  }
  vf get(const float* x, int stride, int column) const {
    float lane[kLanes];
    for (int l = 0; l < kLanes; ++l) lane[l] = x[size_t(index[l]) * stride + column];
    return load(lane);
  }
  void put(float* x, int stride, int column, vf v) const {
    float lane[kLanes];
    store(lane, v);
    for (int l = 0; l < size; ++l) x[size_t(first + l) * stride + column] = lane[l];
  }
};

// What of a group does not depend on the camera.
struct Model {
  vf mean[3], quat[4], length, scale[3], R[3][3],
      A[3][3];              // quat: unit; A = R diag(scale), so that A A^T is the covariance
  vf opacity, shortest[3];  // shortest: 1 for the axis of the smallest scale, else 0
  mask usable;

  Model(const Scene& s, const Group& g) {
    vf q[4], log_scale[3];
    const vf logit = g.get(s.opacity_logits, 1, 0);
    opacity = vf(1.0f) / (vf(1.0f) + exp(-logit));
    for (int i = 0; i < 3; ++i) {
      mean[i] = g.get(s.means, 3, i);
      log_scale[i] = g.get(s.log_scales, 3, i);
      scale[i] = exp(log_scale[i]);
    }
    for (int i = 0; i < 4; ++i) q[i] = g.get(s.quats, 4, i);
    length = sqrt(fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3]))));
    const mask turned = vf(kMinNorm) < length;
    usable = finite(length) & (vf(0.0f) <= opacity);  // false for what is not a number
    for (int i = 0; i < 4; ++i) quat[i] = select(turned, q[i] / length, i ? 0.0f : 1.0f);
    const vf w = quat[0], x = quat[1], y = quat[2], z = quat[3];
    R[0][0] = vf(1.0f) - (y * y + z * z) * 2.0f;
    R[0][1] = (x * y - w * z) * 2.0f;
    R[0][2] = (x * z + w * y) * 2.0f;
    R[1][0] = (x * y + w * z) * 2.0f;
    R[1][1] = vf(1.0f) - (x * x + z * z) * 2.0f;
    R[1][2] = (y * z - w * x) * 2.0f;
    R[2][0] = (x * z - w * y) * 2.0f;
    R[2][1] = (y * z + w * x) * 2.0f;
    R[2][2] = vf(1.0f) - (x * x + y * y) * 2.0f;
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k) A[i][k] = R[i][k] * scale[k];
    const mask second = log_scale[1] < log_scale[0];
    const vf smallest = select(second, log_scale[1], log_scale[0]);
    shortest[2] = zero_unless(log_scale[2] < smallest, 1.0f);
    shortest[1] = zero_unless(second, vf(1.0f) - shortest[2]);
    shortest[0] = vf(1.0f) - shortest[1] - shortest[2];
  }
};

struct Camera {
  float R[3][3], t[3], fx, fy, cx, cy, limit_x, limit_y, footprint_px2;
  const float *sun_dir, *sunlit, *added;  // [3], [gaussians] and [gaussians, channels], or null

  Camera(const Scene& s, int index) {
    const float *w = s.world_to_camera + 16 * index, *K = s.K + 9 * index;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) R[i][j] = w[4 * i + j];
      t[i] = w[4 * i + 3];
    }
    fx = K[0];
    fy = K[4];
    cx = K[2];
    cy = K[5];
    limit_x = kFovMargin * std::max(cx, s.width - cx) / fx;
    limit_y = kFovMargin * std::max(cy, s.height - cy) / fy;
    footprint_px2 = s.footprint_px2[index];
    sun_dir = s.sun_dir ? s.sun_dir + 3 * index : nullptr;
    sunlit = s.sunlit ? s.sunlit + size_t(index) * s.gaussians : nullptr;
    added = s.added ? s.added + size_t(index) * s.gaussians * s.channels : nullptr;
  }
};

// A group in one camera, in the symbols of Zwicker et al. 2001: the covariance is M M^T + footprint, M = J R A.
struct Projection {
  vf p[3], inverse_z, x, y, clamped_x, clamped_y;  // p: camera frame, m; x, y: at distance 1
  vf J00, J02, J11, J12, U[2][3], M[2][3];         // U = J R
  vf xx, xy, yy, determinant;                      // of the widened covariance, px^2
  vf cross[3], share;  // cross: M0 x M1, its square is the determinant of M M^T; share: of the opacity, at the peak
  mask drawn;

  Projection(const Scene& s, const Model& m, const Camera& c) {
    drawn = m.usable;
    for (int i = 0; i < 3; ++i) {
      p[i] = fma(m.mean[0], c.R[i][0], fma(m.mean[1], c.R[i][1], fma(m.mean[2], c.R[i][2], c.t[i])));
      drawn = drawn & finite(p[i]);
    }
    drawn = drawn & (vf(s.near_m) < p[2]);
    inverse_z = vf(1.0f) / p[2];
    x = p[0] * inverse_z;
    y = p[1] * inverse_z;
    clamped_x = larger(smaller(x, c.limit_x), -c.limit_x);
    clamped_y = larger(smaller(y, c.limit_y), -c.limit_y);
    J00 = inverse_z * c.fx;
    J02 = -(J00 * clamped_x);
    J11 = inverse_z * c.fy;
    J12 = -(J11 * clamped_y);
    for (int j = 0; j < 3; ++j) {
      U[0][j] = fma(J02, c.R[2][j], J00 * c.R[0][j]);
      U[1][j] = fma(J12, c.R[2][j], J11 * c.R[1][j]);
    }
    for (int r = 0; r < 2; ++r)
      for (int k = 0; k < 3; ++k) M[r][k] = fma(U[r][2], m.A[2][k], fma(U[r][1], m.A[1][k], U[r][0] * m.A[0][k]));
    const vf footprint = c.footprint_px2, trace = dot(M[0], M[0]) + dot(M[1], M[1]);
    for (int k = 0; k < 3; ++k) {
      const int a = (k + 1) % 3, b = (k + 2) % 3;
      cross[k] = fma(M[0][a], M[1][b], -(M[0][b] * M[1][a]));
    }
    xx = dot(M[0], M[0]) + footprint;
    xy = dot(M[0], M[1]);
    yy = dot(M[1], M[1]) + footprint;
    const vf narrow = dot(cross, cross);
    determinant = narrow + trace * footprint + footprint * footprint;  // a sum of squares: nothing cancels
    drawn = drawn & finite(determinant);
    share = 1.0f;
    if (s.peak_lowered) {
      share = sqrt(narrow / determinant);
      drawn = drawn & (vf(kMinPeakShare) <= share);
    }
  }
};

}  // namespace
}  // namespace KERNEL
}  // namespace obbgs

// The radiance of a vector of Gaussians towards a camera, as in lighting.py and sh.py.
// Included once for each instruction set, by project.cpp and project_backward.cpp.
#pragma once
#include "projection.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr float kSoftplusLinear = 20.0f;  // softplus(x) is x where kSoftness x is above this, as in PyTorch

// Real spherical harmonics in 3DGS order and signs, and their derivatives with respect to the direction.
inline void sh_basis(const vf* d, int count, vf* basis) {
  const vf x = d[0], y = d[1], z = d[2];
  basis[0] = 0.28209479177387814f;
  if (count > 1) {
    basis[1] = y * -0.4886025119029199f;
    basis[2] = z * 0.4886025119029199f;
    basis[3] = x * -0.4886025119029199f;
  }
  if (count > 4) {
    basis[4] = x * y * 1.0925484305920792f;
    basis[5] = y * z * -1.0925484305920792f;
    basis[6] = (z * z * 2.0f - x * x - y * y) * 0.31539156525252005f;
    basis[7] = x * z * -1.0925484305920792f;
    basis[8] = (x * x - y * y) * 0.5462742152960396f;
  }
  if (count > 9) {
    basis[9] = y * (x * x * 3.0f - y * y) * -0.5900435899266435f;
    basis[10] = x * y * z * 2.890611442640554f;
    basis[11] = y * (z * z * 4.0f - x * x - y * y) * -0.4570457994644658f;
    basis[12] = z * (z * z * 2.0f - x * x * 3.0f - y * y * 3.0f) * 0.3731763325901154f;
    basis[13] = x * (z * z * 4.0f - x * x - y * y) * -0.4570457994644658f;
    basis[14] = z * (x * x - y * y) * 1.445305721320277f;
    basis[15] = x * (x * x - y * y * 3.0f) * -0.5900435899266435f;
  }
}

// Returns in `gradient` the derivative of sum(weight[k] basis[k]) with respect to the direction.
inline void sh_basis_backward(const vf* d, int count, const vf* weight, vf* gradient) {
  const vf x = d[0], y = d[1], z = d[2];
  vf gx = 0.0f, gy = 0.0f, gz = 0.0f;
  const auto add = [&](int k, float factor, vf by_x, vf by_y, vf by_z) {
    const vf w = weight[k] * factor;
    gx = gx + w * by_x;
    gy = gy + w * by_y;
    gz = gz + w * by_z;
  };
  const vf zero = 0.0f, one = 1.0f;
  if (count > 1) {
    add(1, -0.4886025119029199f, zero, one, zero);
    add(2, 0.4886025119029199f, zero, zero, one);
    add(3, -0.4886025119029199f, one, zero, zero);
  }
  if (count > 4) {
    add(4, 1.0925484305920792f, y, x, zero);
    add(5, -1.0925484305920792f, zero, z, y);
    add(6, 0.31539156525252005f, x * -2.0f, y * -2.0f, z * 4.0f);
    add(7, -1.0925484305920792f, z, zero, x);
    add(8, 0.5462742152960396f, x * 2.0f, y * -2.0f, zero);
  }
  if (count > 9) {
    const vf xx = x * x, yy = y * y, zz = z * z;
    add(9, -0.5900435899266435f, x * y * 6.0f, (xx - yy) * 3.0f, zero);
    add(10, 2.890611442640554f, y * z, x * z, x * y);
    add(11, -0.4570457994644658f, x * y * -2.0f, zz * 4.0f - xx - yy * 3.0f, y * z * 8.0f);
    add(12, 0.3731763325901154f, x * z * -6.0f, y * z * -6.0f, zz * 6.0f - xx * 3.0f - yy * 3.0f);
    add(13, -0.4570457994644658f, zz * 4.0f - xx * 3.0f - yy, x * y * -2.0f, x * z * 8.0f);
    add(14, 1.445305721320277f, x * z * 2.0f, y * z * -2.0f, xx - yy);
    add(15, -0.5900435899266435f, (xx - yy) * 3.0f, x * y * -6.0f, zero);
  }
  gradient[0] = gx;
  gradient[1] = gy;
  gradient[2] = gz;
}

inline vf softplus(vf x) {
  const vf scaled = x * kSoftness, e = exp(-absolute(scaled));
  const vf soft = larger(scaled, 0.0f) + atanh_third(e / (e + 2.0f)) * 2.0f;  // log1p(e) = 2 atanh(e / (2 + e))
  return select(vf(kSoftplusLinear) < scaled, x, soft * (1.0f / kSoftness));
}
inline vf softplus_slope(vf x) {
  const vf scaled = x * kSoftness;
  return select(vf(kSoftplusLinear) < scaled, 1.0f, vf(1.0f) / (vf(1.0f) + exp(-scaled)));
}

// The radiance of a group towards a camera.
struct Shading {
  vf direction[3], distance, basis[16], raw[3], added[3];
  vf facing;                                    // sign that turns the normal against `direction`
  vf normal[3], sun[3], cosine, sunlit, light;  // sun: where it is given; cosine, sunlit: under Lambert's law

  Shading(const Scene& s, const Group& g, const Model& m, const Camera& c) {
    for (int j = 0; j < 3; ++j)
      direction[j] = m.mean[j] + (c.R[0][j] * c.t[0] + c.R[1][j] * c.t[1] + c.R[2][j] * c.t[2]);
    distance = larger(sqrt(dot(direction, direction)), kMinNorm);
    for (vf& d : direction) d = d / distance;
    if (c.sun_dir)
      for (int j = 0; j < 3; ++j) sun[j] = c.sun_dir[j];
    sh_basis(c.sun_dir ? sun : direction, s.sh_count, basis);
    for (int f = 0; f < s.channels; ++f) {
      raw[f] = 0.0f;
      for (int k = 0; k < s.sh_count; ++k)
        raw[f] = fma(basis[k], g.get(s.sh, s.sh_count * s.channels, k * s.channels + f), raw[f]);
      added[f] = c.added ? g.get(c.added, s.channels, f) : vf(0.0f);
    }
    light = 1.0f;
    if (c.sunlit) {
      for (int i = 0; i < 3; ++i) normal[i] = dot(m.R[i], m.shortest);
      const vf along = dot(normal, direction);
      facing = zero_unless(along < vf(0.0f), 1.0f) - zero_unless(vf(0.0f) < along, 1.0f);
    }
    if (c.sunlit) {
      sunlit = g.get(c.sunlit, 1, 0);
      cosine = dot(normal, sun) * facing;
      light = fma(softplus(cosine), sunlit, s.ambient);
    }
  }

  vf radiance(int f) const { return fma(softplus(raw[f]), light, added[f]); }
};

}  // namespace
}  // namespace KERNEL
}  // namespace obbgs

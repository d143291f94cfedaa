// Gaussians to splats: the affine (EWA) projection, opacity and radiance, and their analytic gradient; sixteen Gaussians a vector.
#include <algorithm>
#include <cfloat>
#include <cmath>
#include <vector>

#include "rasterizer.h"
#include "simd.h"
#include "threads.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr int kChunk = 256;           // Gaussians a unit of parallel work; the order of sums does not depend on threads
constexpr size_t kGrain = 8192;       // splats that are worth a thread
constexpr float kHalfLog2E = 0.84932180f;  // sqrt(log2(e) / 2): turns the Cholesky factor of a conic into k1, k2, k3
constexpr float kLn2 = 0.693147181f;
constexpr float kSoftness = 10.0f;    // softplus(x, beta = 10) as in sh.py
constexpr float kLinear = 20.0f;      // beta x above which softplus is x, as in PyTorch
constexpr float kMinNorm = 1e-12f;

inline mask finite(vf x) { return absolute(x) <= vf(FLT_MAX); }
inline vf dot(const vf* a, const vf* b) { return fma(a[2], b[2], fma(a[1], b[1], a[0] * b[0])); }

// Sixteen Gaussians from `first` on; the last one is repeated beyond the end.
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

// What does not depend on the camera.
struct Model {
  vf mean[3], quat[4], length, scale[3], R[3][3], A[3][3];  // quat unit; A = R diag(scale): covariance A A^T
  vf opacity, shortest[3];                                  // shortest: one-hot axis of the smallest scale
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
  float R[3][3], t[3], fx, fy, cx, cy, limit_x, limit_y;
  const float *sun_dir, *sunlit;  // [3] and [gaussians], or null

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
    sun_dir = s.sun_dir ? s.sun_dir + 3 * index : nullptr;
    sunlit = s.sunlit ? s.sunlit + size_t(index) * s.gaussians : nullptr;
  }
};

// The Gaussians in one camera, in the symbols of Zwicker et al.: covariance M M^T + dilation with M = J R A.
struct Projection {
  vf p[3], inverse_z, x, y, clamped_x, clamped_y;  // p: camera frame, m; x, y: at distance 1
  vf J00, J02, J11, J12, U[2][3], M[2][3];         // U = J R
  vf xx, xy, yy, determinant;                      // of the dilated covariance, px^2
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
    const vf undilated = dot(M[0], M[0]) + dot(M[1], M[1]);
    vf cross[3];
    for (int k = 0; k < 3; ++k) {
      const int a = (k + 1) % 3, b = (k + 2) % 3;
      cross[k] = fma(M[0][a], M[1][b], -(M[0][b] * M[1][a]));
    }
    xx = dot(M[0], M[0]) + kDilation;
    xy = dot(M[0], M[1]);
    yy = dot(M[1], M[1]) + kDilation;
    determinant = dot(cross, cross) + undilated * kDilation + kDilation * kDilation;  // a sum of squares: nothing cancels
    drawn = drawn & finite(determinant);
  }
};

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
  return select(vf(kLinear) < scaled, x, soft * (1.0f / kSoftness));
}
inline vf softplus_slope(vf x) {
  const vf scaled = x * kSoftness;
  return select(vf(kLinear) < scaled, 1.0f, vf(1.0f) / (vf(1.0f) + exp(-scaled)));
}

// How a Gaussian shines towards a camera.
struct Shading {
  vf direction[3], distance, basis[16], raw[3], facing;  // facing: sign that turns the normal away from `direction`
  vf normal[3], sun[3], cosine, sunlit, light;           // cosine and sunlit: only where Lambert's law holds

  Shading(const Scene& s, const Group& g, const Model& m, const Camera& c) {
    for (int j = 0; j < 3; ++j) direction[j] = m.mean[j] + (c.R[0][j] * c.t[0] + c.R[1][j] * c.t[1] + c.R[2][j] * c.t[2]);
    distance = larger(sqrt(dot(direction, direction)), kMinNorm);
    for (vf& d : direction) d = d / distance;
    if (c.sun_dir)
      for (int j = 0; j < 3; ++j) sun[j] = c.sun_dir[j];
    sh_basis(c.sun_dir ? sun : direction, s.sh_count, basis);
    for (int f = 0; f < s.channels; ++f) {
      raw[f] = 0.0f;
      for (int k = 0; k < s.sh_count; ++k) raw[f] = fma(basis[k], g.get(s.sh, s.sh_count * s.channels, k * s.channels + f), raw[f]);
    }
    light = 1.0f;
    if (s.normals || c.sunlit) {
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

  vf radiance(int f) const { return softplus(raw[f]) * light; }
};

}  // namespace

void project(const Scene& s, Frame& frame, float* means2d, float* radii, int threads) {
  const int chunks = (s.gaussians + kChunk - 1) / kChunk;
  frame.splats.resize(size_t(s.cameras) * s.gaussians);
  frame.visible.resize(size_t(s.cameras) * s.gaussians);
  std::vector<uint32_t> visible(size_t(s.cameras) * chunks, 0);
  std::vector<Camera> cameras;
  for (int c = 0; c < s.cameras; ++c) cameras.emplace_back(s, c);
  parallel_for(chunks, worthwhile(threads, size_t(s.cameras) * s.gaussians, kGrain), [&](int chunk) {
    for (int first = chunk * kChunk; first < std::min(s.gaussians, (chunk + 1) * kChunk); first += kLanes) {
      const Group group(s, first);
      const Model model(s, group);
      for (int c = 0; c < s.cameras; ++c) {
        const Camera& camera = cameras[c];
        const Projection p(s, model, camera);
        const vf mx = select(p.drawn, fma(p.x, camera.fx, camera.cx), camera.cx);
        const vf my = select(p.drawn, fma(p.y, camera.fy, camera.cy), camera.cy);
        const vf middle = (p.xx + p.yy) * 0.5f, spread = larger(fma(middle, middle, -p.determinant), 0.1f);
        const size_t base = size_t(c) * s.gaussians;
        group.put(means2d + 2 * base, 2, 0, mx);
        group.put(means2d + 2 * base, 2, 1, my);
        const vf radius = zero_unless(p.drawn, sqrt(middle + sqrt(spread)) * 3.0f);
        const vf whole = to_float(truncate(smaller(radius, 8e6f)));  // beyond, every float is whole
        group.put(radii + base, 1, 0, larger(select(whole < radius, whole + 1.0f, whole), select(vf(8e6f) < radius, radius, 0.0f)));

        const vf level = log2(model.opacity), reach = sqrt(larger(level + 7.99435344f, 0.0f)) * (1.01f / kHalfLog2E);
        const vf reach_x = reach * sqrt(p.xx), reach_y = reach * sqrt(p.yy);
        const mask seen = p.drawn & (vf(kMinAlpha) <= model.opacity) & finite(mx) & finite(my) & (vf(0.0f) <= mx + reach_x) & (mx - reach_x <= vf(float(s.width))) &
                          (vf(0.0f) <= my + reach_y) & (my - reach_y <= vf(float(s.height)));
        Splat* splats = &frame.splats[base + first];
        for (int l = 0; l < group.size; ++l) splats[l].records = 0;
        if (!any(seen)) continue;
        const Shading shading(s, group, model, camera);
        const vf k1 = sqrt(p.yy / p.determinant) * kHalfLog2E;
        vf columns[6 + kMaxFeatures] = {mx, my, k1, -(p.xy / p.yy * k1), vf(kHalfLog2E) / sqrt(p.yy), level};
        mask bright = seen;
        for (int f = 0; f < s.channels; ++f) {
          columns[6 + f] = shading.radiance(f);
          bright = bright & finite(columns[6 + f]);
        }
        columns[6 + s.channels] = p.p[2];
        if (s.normals)
          for (int i = 0; i < 3; ++i) columns[7 + s.channels + i] = shading.normal[i] * shading.facing;
        uint32_t& count = visible[size_t(c) * chunks + chunk];
        const vf flags = zero_unless(bright, 1.0f);
        for (int l = 0; l < group.size; ++l) {
          if (flags[l] == 0.0f) continue;
          float* to = &splats[l].x;
          for (int i = 0; i < 6 + s.features(); ++i) to[i] = columns[i][l];
          DepthKey key{0, uint32_t(base + first + l)};
          std::memcpy(&key.depth_bits, &to[6 + s.channels], 4);
          frame.visible[base + size_t(chunk) * kChunk + count++] = key;
        }
      }
    }
  });
  frame.visible_count = 0;
  for (int c = 0; c < s.cameras; ++c)
    for (int chunk = 0; chunk < chunks; ++chunk) {
      const DepthKey* from = &frame.visible[size_t(c) * s.gaussians + size_t(chunk) * kChunk];
      const uint32_t count = visible[size_t(c) * chunks + chunk];
      std::memmove(frame.visible.data() + frame.visible_count, from, count * sizeof(DepthKey));
      frame.visible_count += count;
    }
}

void project_backward(const Scene& s, const Frame& frame, const float* records, int features, const SceneGradients& out, int threads) {
  const int chunks = (s.gaussians + kChunk - 1) / kChunk;
  std::vector<Camera> cameras;
  for (int c = 0; c < s.cameras; ++c) cameras.emplace_back(s, c);
  std::vector<float> poses(size_t(chunks) * s.cameras * 12);  // a chunk's share of each pose gradient: R, then t
  std::vector<float> ambient(chunks);
  parallel_for(chunks, worthwhile(threads, size_t(s.cameras) * s.gaussians, kGrain), [&](int chunk) {
    std::vector<vf> pose(size_t(s.cameras) * 12, vf(0.0f));
    vf d_ambient = 0.0f;
    for (int first = chunk * kChunk; first < std::min(s.gaussians, (chunk + 1) * kChunk); first += kLanes) {
      const Group group(s, first);
      const Model m(s, group);
      const int coefficients = s.sh_count * s.channels;
      const bool turning = s.sh_count > 1 && !s.sun_dir;  // the radiance turns with the line of sight
      vf d_mean[3], d_A[3][3], d_R[3][3], d_logit = 0.0f, d_sh[48];
      for (int i = 0; i < 3; ++i) {
        d_mean[i] = 0.0f;
        for (int k = 0; k < 3; ++k) d_A[i][k] = d_R[i][k] = 0.0f;
      }
      for (int k = 0; k < coefficients; ++k) d_sh[k] = 0.0f;
      for (int c = 0; c < s.cameras; ++c) {
        const size_t base = size_t(c) * s.gaussians;
        const Splat* splats = &frame.splats[base + first];
        for (int l = kLanes; l < 2 * kLanes && first + l < s.gaussians; ++l)  // the next group's records: they lie by depth
          if (splats[l].records) __builtin_prefetch(records + size_t(splats[l].first_record) * kRecord);
        float total[kLanes][kRecord] = {}, k[3][kLanes] = {}, lit[kLanes] = {};
        bool none = true;
        for (int l = 0; l < group.size; ++l) {
          for (uint32_t r = 0; r < splats[l].records; ++r) {
            const float* record = records + size_t(splats[l].first_record + r) * kRecord;
            for (int i = 0; i < kRecord; ++i) total[l][i] += record[i];
          }
          out.pixels[base + first + l] = total[l][kPixels];
          if (total[l][kPixels] > 0) {
            k[0][l] = splats[l].k1;
            k[1][l] = splats[l].k2;
            k[2][l] = splats[l].k3;
          } else if (!out.means2d_in) {
            continue;
          }
          lit[l] = 1.0f;
          none = false;
        }
        const auto get = [&](int i) {
          float lane[kLanes];
          for (int l = 0; l < kLanes; ++l) lane[l] = total[l][slot(i)];
          return load(lane);
        };
        if (none) {
          for (int l = 0; l < 2 * group.size; ++l) out.means2d[2 * (base + first) + l] = 0.0f;
          continue;
        }
        const Camera& camera = cameras[c];
        const Projection p(s, m, camera);
        const mask on = p.drawn & (vf(0.0f) < load(lit));
        const vf k1 = load(k[0]), k2 = load(k[1]), k3 = load(k[2]);
        const vf gu = get(kGU), gv = get(kGV), guu = get(kGUU), guv = get(kGUV), gvv = get(kGVV);
        d_logit = d_logit + zero_unless(on, get(kG) * (vf(1.0f) - m.opacity));

        // the screen: d power / d mean = conic d, d power / d covariance = 1/2 conic d d^T conic, with conic = 2 ln2 L^T L
        vf d_x = k1 * gu * (2 * kLn2), d_y = (k2 * gu + k3 * gv) * (2 * kLn2);
        group.put(out.means2d + 2 * base, 2, 0, d_x);
        group.put(out.means2d + 2 * base, 2, 1, d_y);
        if (out.means2d_in) {
          d_x = d_x + group.get(out.means2d_in + 2 * base, 2, 0);
          d_y = d_y + group.get(out.means2d_in + 2 * base, 2, 1);
        }
        constexpr float kSquare = 2 * kLn2 * kLn2;
        const vf row_u = k2 * guu + k3 * guv, row_v = k2 * guv + k3 * gvv;
        const vf d_xx = k1 * k1 * guu * kSquare, d_xy = k1 * row_u * kSquare, d_yy = (k2 * row_u + k3 * row_v) * kSquare;

        // covariance = M M^T, M = U A, U = J R
        vf d_M[2][3], d_U[2][3], d_p[3];
        for (int i = 0; i < 3; ++i) {
          d_M[0][i] = (d_xx * p.M[0][i] + d_xy * p.M[1][i]) * 2.0f;
          d_M[1][i] = (d_xy * p.M[0][i] + d_yy * p.M[1][i]) * 2.0f;
        }
        for (int i = 0; i < 3; ++i) {
          for (int r = 0; r < 2; ++r) d_U[r][i] = dot(d_M[r], m.A[i]);
          for (int a = 0; a < 3; ++a) d_A[i][a] = d_A[i][a] + zero_unless(on, p.U[0][i] * d_M[0][a] + p.U[1][i] * d_M[1][a]);
        }
        vf R[3][3];
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) R[i][j] = camera.R[i][j];
        const vf d_J00 = dot(d_U[0], R[0]), d_J02 = dot(d_U[0], R[2]), d_J11 = dot(d_U[1], R[1]), d_J12 = dot(d_U[1], R[2]);
        const vf to_x = d_x * camera.fx + zero_unless(absolute(p.x) < vf(camera.limit_x), -(p.J00 * d_J02));
        const vf to_y = d_y * camera.fy + zero_unless(absolute(p.y) < vf(camera.limit_y), -(p.J11 * d_J12));
        const vf along = p.J00 * d_J00 + p.J02 * d_J02 + p.J11 * d_J11 + p.J12 * d_J12 + to_x * p.x + to_y * p.y;
        d_p[0] = to_x * p.inverse_z;
        d_p[1] = to_y * p.inverse_z;
        d_p[2] = (features > s.channels ? get(kFirstFeature + s.channels) : vf(0.0f)) - along * p.inverse_z;

        vf d_direction[3] = {0.0f, 0.0f, 0.0f};
        const Shading shading(s, group, m, camera);
        vf weight[16], d_light = 0.0f, d_cosine = 0.0f;
        for (int b = 0; b < s.sh_count; ++b) weight[b] = 0.0f;
        for (int f = 0; f < s.channels; ++f) {
          const vf d_radiance = get(kFirstFeature + f), d_raw = d_radiance * softplus_slope(shading.raw[f]) * shading.light;
          if (s.sunlit) d_light = d_light + d_radiance * softplus(shading.raw[f]);
          for (int b = 0; b < s.sh_count; ++b) {
            const int i = b * s.channels + f;
            d_sh[i] = d_sh[i] + zero_unless(on, d_raw * shading.basis[b]);
            if (turning) weight[b] = weight[b] + d_raw * group.get(s.sh, coefficients, i);
          }
        }
        if (s.sunlit) {
          d_cosine = d_light * shading.sunlit * softplus_slope(shading.cosine);
          d_ambient = d_ambient + zero_unless(on, d_light);
        }
        if (turning) {  // through the unit direction
          vf d_unit[3];
          sh_basis_backward(shading.direction, s.sh_count, weight, d_unit);
          const vf radial = dot(d_unit, shading.direction);
          for (int j = 0; j < 3; ++j) d_direction[j] = (d_unit[j] - shading.direction[j] * radial) / shading.distance;
        }
        const bool normals = features > s.channels + 1;
        for (int i = 0; i < 3 && (normals || s.sunlit); ++i) {
          vf d_normal = normals ? get(kFirstFeature + s.channels + 1 + i) : vf(0.0f);
          if (s.sunlit) d_normal = d_normal + d_cosine * shading.sun[i];
          d_normal = zero_unless(on, d_normal * shading.facing);
          for (int a = 0; a < 3; ++a) d_R[i][a] = d_R[i][a] + d_normal * m.shortest[a];
        }

        // p = R mean + t; direction = mean + R^T t
        vf* d_pose = &pose[size_t(c) * 12];
        for (int j = 0; j < 3; ++j)
          d_mean[j] = d_mean[j] + zero_unless(on, d_p[0] * R[0][j] + d_p[1] * R[1][j] + d_p[2] * R[2][j] + d_direction[j]);
        for (int i = 0; i < 3; ++i) {
          for (int j = 0; j < 3; ++j) {
            const vf by_J = i == 0 ? p.J00 * d_U[0][j] : i == 1 ? p.J11 * d_U[1][j] : p.J02 * d_U[0][j] + p.J12 * d_U[1][j];
            d_pose[3 * i + j] = d_pose[3 * i + j] + zero_unless(on, d_p[i] * m.mean[j] + by_J + d_direction[j] * camera.t[i]);
          }
          d_pose[9 + i] = d_pose[9 + i] + zero_unless(on, d_p[i] + dot(d_direction, R[i]));
        }
      }

      vf d_quat[4];
      for (int k = 0; k < 3; ++k) {
        vf d_scale = 0.0f;
        for (int i = 0; i < 3; ++i) {
          d_scale = d_scale + zero_unless(finite(m.A[i][k]), d_A[i][k] * m.A[i][k]);
          d_R[i][k] = d_R[i][k] + zero_unless(finite(m.scale[k]), d_A[i][k] * m.scale[k]);
        }
        group.put(out.means, 3, k, d_mean[k]);
        group.put(out.log_scales, 3, k, d_scale);
      }
      const vf w = m.quat[0], x = m.quat[1], y = m.quat[2], z = m.quat[3];
      d_quat[0] = (x * (d_R[2][1] - d_R[1][2]) + y * (d_R[0][2] - d_R[2][0]) + z * (d_R[1][0] - d_R[0][1])) * 2.0f;
      d_quat[1] = (y * (d_R[0][1] + d_R[1][0]) + z * (d_R[0][2] + d_R[2][0]) + w * (d_R[2][1] - d_R[1][2]) - x * (d_R[1][1] + d_R[2][2]) * 2.0f) * 2.0f;
      d_quat[2] = (x * (d_R[0][1] + d_R[1][0]) + z * (d_R[1][2] + d_R[2][1]) + w * (d_R[0][2] - d_R[2][0]) - y * (d_R[0][0] + d_R[2][2]) * 2.0f) * 2.0f;
      d_quat[3] = (x * (d_R[0][2] + d_R[2][0]) + y * (d_R[1][2] + d_R[2][1]) + w * (d_R[1][0] - d_R[0][1]) - z * (d_R[0][0] + d_R[1][1]) * 2.0f) * 2.0f;
      const vf radial = d_quat[0] * w + d_quat[1] * x + d_quat[2] * y + d_quat[3] * z;
      const mask turned = m.usable & (vf(kMinNorm) < m.length);
      for (int i = 0; i < 4; ++i) group.put(out.quats, 4, i, zero_unless(turned, (d_quat[i] - m.quat[i] * radial) / m.length));
      group.put(out.opacity_logits, 1, 0, d_logit);
      for (int i = 0; i < coefficients; ++i) group.put(out.sh, coefficients, i, d_sh[i]);
    }
    for (int i = 0; i < s.cameras * 12; ++i) poses[size_t(chunk) * s.cameras * 12 + i] = sum(pose[i]);
    ambient[chunk] = sum(d_ambient);
  });
  double all_ambient = 0;
  for (const float part : ambient) all_ambient += part;
  *out.ambient = float(all_ambient);
  for (int c = 0; c < s.cameras; ++c) {
    double total[12] = {};
    for (int chunk = 0; chunk < chunks; ++chunk)
      for (int i = 0; i < 12; ++i) total[i] += poses[(size_t(chunk) * s.cameras + c) * 12 + i];
    float* matrix = out.world_to_camera + 16 * c;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) matrix[4 * i + j] = float(total[3 * i + j]);
      matrix[4 * i + 3] = float(total[9 + i]);
      matrix[12 + i] = 0.0f;
    }
    matrix[15] = 0.0f;
  }
}

}  // namespace KERNEL
}  // namespace obbgs

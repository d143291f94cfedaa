// The gradient of the projection, from the sums that compositing left for each splat to the model and the poses;
// a vector of Gaussians at a time. d_x stands for the derivative of the loss by x.
#include <vector>

#include "machine/threads.h"
#include "projection.h"
#include "shading.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr float kLn2 = 0.693147181f;
constexpr int kCamera = 13;  // numbers of a camera's gradient: R, t, then the footprint

// The gradient records of one group in one camera, added up, and the shapes of its splats.
struct SplatSums {
  float total[kLanes][kRecord] = {}, k[3][kLanes] = {}, lit[kLanes] = {};
  bool none = true;  // no Gaussian of the group has a gradient here

  SplatSums(const Scene& s, const Group& group, const Splat* splats, const float* records, bool given_means2d,
            float* pixels) {
    // the next group's records lie anywhere
    for (int l = kLanes; l < 2 * kLanes && group.first + l < s.gaussians && (group.first + l) % kChunk; ++l)
      if (splats[l].records) __builtin_prefetch(records + size_t(splats[l].first_record) * kRecord);
    for (int l = 0; l < group.size; ++l) {
      for (uint32_t r = 0; r < splats[l].records; ++r) {
        const float* record = records + size_t(splats[l].first_record + r) * kRecord;
        for (int i = 0; i < kRecord; ++i) total[l][i] += record[i];
      }
      pixels[l] = total[l][slot(kPixels)];
      if (total[l][slot(kPixels)] > 0) {
        k[0][l] = splats[l].k1;
        k[1][l] = splats[l].k2;
        k[2][l] = splats[l].k3;
      } else if (!given_means2d) {
        continue;
      }
      lit[l] = 1.0f;
      none = false;
    }
  }

  vf get(int sum) const {
    float lane[kLanes];
    for (int l = 0; l < kLanes; ++l) lane[l] = total[l][slot(sum)];
    return load(lane);
  }
};

// Gradients of one group, added up over the cameras.
struct GroupGradients {
  vf mean[3], A[3][3], R[3][3], logit, sh[kMaxCoefficients * kMaxChannels];

  explicit GroupGradients(int coefficients) {
    logit = 0.0f;
    for (int i = 0; i < 3; ++i) {
      mean[i] = 0.0f;
      for (int k = 0; k < 3; ++k) A[i][k] = R[i][k] = 0.0f;
    }
    for (int k = 0; k < coefficients; ++k) sh[k] = 0.0f;
  }
};

// Derivatives by the projected mean (px) and by the widened covariance (px^2): xy is by each of its two off-diagonal
// elements.
struct ScreenGradient {
  vf x, y, xx, xy, yy;

  // d power / d mean = conic d, d power / d covariance = 1/2 conic d d^T conic, with conic = 2 ln2 L^T L
  OBBGS_INLINE explicit ScreenGradient(const SplatSums& sums) {
    const vf k1 = load(sums.k[0]), k2 = load(sums.k[1]), k3 = load(sums.k[2]);
    const vf gu = sums.get(kGU), gv = sums.get(kGV), guu = sums.get(kGUU), guv = sums.get(kGUV), gvv = sums.get(kGVV);
    constexpr float kSquare = 2 * kLn2 * kLn2;
    x = k1 * gu * (2 * kLn2);
    y = (k2 * gu + k3 * gv) * (2 * kLn2);
    const vf row_u = k2 * guu + k3 * guv, row_v = k2 * guv + k3 * gvv;
    xx = k1 * k1 * guu * kSquare;
    xy = k1 * row_u * kSquare;
    yy = (k2 * row_u + k3 * row_v) * kSquare;
  }
};

// Through covariance = M M^T + footprint, M = U A, U = J R: adds to d_A, sets d_U and returns the derivative by the
// footprint. A lowered peak has the factor sqrt(|cross|^2 / determinant); d_peak is the derivative by its logarithm.
OBBGS_INLINE vf covariance_backward(const Scene& s, const Model& m, const Projection& p, mask on, ScreenGradient d,
                                    vf d_peak, vf (&d_A)[3][3], vf (&d_U)[2][3]) {
  if (s.peak_lowered) {
    const vf half = d_peak / p.determinant * 0.5f;
    d.xx = d.xx - half * p.yy;
    d.xy = d.xy + half * p.xy;
    d.yy = d.yy - half * p.xx;
  }
  vf d_M[2][3];
  for (int i = 0; i < 3; ++i) {
    d_M[0][i] = (d.xx * p.M[0][i] + d.xy * p.M[1][i]) * 2.0f;
    d_M[1][i] = (d.xy * p.M[0][i] + d.yy * p.M[1][i]) * 2.0f;
  }
  if (s.peak_lowered) {
    const vf square = dot(p.cross, p.cross), by_square = zero_unless(vf(0.0f) < square, d_peak / square);
    for (int i = 0; i < 3; ++i) {
      const int a = (i + 1) % 3, b = (i + 2) % 3;
      d_M[0][i] = d_M[0][i] + by_square * (p.M[1][a] * p.cross[b] - p.M[1][b] * p.cross[a]);
      d_M[1][i] = d_M[1][i] - by_square * (p.M[0][a] * p.cross[b] - p.M[0][b] * p.cross[a]);
    }
  }
  for (int i = 0; i < 3; ++i) {
    for (int r = 0; r < 2; ++r) d_U[r][i] = dot(d_M[r], m.A[i]);
    for (int a = 0; a < 3; ++a) d_A[i][a] = d_A[i][a] + zero_unless(on, p.U[0][i] * d_M[0][a] + p.U[1][i] * d_M[1][a]);
  }
  return zero_unless(on, d.xx + d.yy);
}

// Through the projected mean and J: sets d_p, the derivative by the mean in the camera frame.
OBBGS_INLINE void point_backward(const Camera& camera, const Projection& p, const vf (&R)[3][3], vf d_x, vf d_y,
                                 vf d_depth, const vf (&d_U)[2][3], vf (&d_p)[3]) {
  const vf d_J00 = dot(d_U[0], R[0]), d_J02 = dot(d_U[0], R[2]), d_J11 = dot(d_U[1], R[1]), d_J12 = dot(d_U[1], R[2]);
  const vf to_x = d_x * camera.fx + zero_unless(absolute(p.x) < vf(camera.limit_x), -(p.J00 * d_J02));
  const vf to_y = d_y * camera.fy + zero_unless(absolute(p.y) < vf(camera.limit_y), -(p.J11 * d_J12));
  const vf along = p.J00 * d_J00 + p.J02 * d_J02 + p.J11 * d_J11 + p.J12 * d_J12 + to_x * p.x + to_y * p.y;
  d_p[0] = to_x * p.inverse_z;
  d_p[1] = to_y * p.inverse_z;
  d_p[2] = d_depth - along * p.inverse_z;
}

// Through the radiance: adds to the group's gradients and d_ambient, writes those by the added radiance, and sets
// d_direction, the derivative by the vector from the camera to the Gaussian.
OBBGS_INLINE void shading_backward(const Scene& s, const Group& group, const Model& m, const Camera& camera,
                                   const SplatSums& sums, int features, mask on, float* added, GroupGradients& d,
                                   vf (&d_direction)[3], vf& d_ambient) {
  const Shading shading(s, group, m, camera);
  const bool view_dependent = s.sh_count > 1 && !s.sun_dir;
  vf weight[kMaxCoefficients], d_light = 0.0f, d_cosine = 0.0f;
  for (int b = 0; b < s.sh_count; ++b) weight[b] = 0.0f;
  for (int f = 0; f < s.channels; ++f) {
    const vf d_radiance = sums.get(kFirstFeature + f);
    if (added) group.put(added, s.channels, f, zero_unless(on, d_radiance));
    const vf d_raw = d_radiance * softplus_slope(shading.raw[f]) * shading.light;
    if (s.sunlit) d_light = d_light + d_radiance * softplus(shading.raw[f]);
    for (int b = 0; b < s.sh_count; ++b) {
      const int i = b * s.channels + f;
      d.sh[i] = d.sh[i] + zero_unless(on, d_raw * shading.basis[b]);
      if (view_dependent) weight[b] = weight[b] + d_raw * group.get(s.sh, s.sh_count * s.channels, i);
    }
  }
  if (s.sunlit) {
    d_cosine = d_light * shading.sunlit * softplus_slope(shading.cosine);
    d_ambient = d_ambient + zero_unless(on, d_light);
  }
  for (vf& component : d_direction) component = 0.0f;
  if (view_dependent) {  // through the normalisation of the direction
    vf d_unit[3];
    sh_basis_backward(shading.direction, s.sh_count, weight, d_unit);
    const vf radial = dot(d_unit, shading.direction);
    for (int j = 0; j < 3; ++j) d_direction[j] = (d_unit[j] - shading.direction[j] * radial) / shading.distance;
  }
  for (int i = 0; i < 3 && s.sunlit; ++i) {
    const vf d_normal = zero_unless(on, d_cosine * shading.sun[i] * shading.facing);
    for (int a = 0; a < 3; ++a) d.R[i][a] = d.R[i][a] + d_normal * m.shortest[a];
  }
}

// Through p = R mean + t and direction = mean + R^T t: adds to d_mean and d_camera.
OBBGS_INLINE void pose_backward(const Model& m, const Camera& camera, const Projection& p, const vf (&R)[3][3], mask on,
                                const vf (&d_p)[3], const vf (&d_U)[2][3], const vf (&d_direction)[3], vf (&d_mean)[3],
                                vf* d_camera) {
  for (int j = 0; j < 3; ++j)
    d_mean[j] = d_mean[j] + zero_unless(on, d_p[0] * R[0][j] + d_p[1] * R[1][j] + d_p[2] * R[2][j] + d_direction[j]);
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      const vf by_J = i == 0 ? p.J00 * d_U[0][j] : i == 1 ? p.J11 * d_U[1][j] : p.J02 * d_U[0][j] + p.J12 * d_U[1][j];
      d_camera[3 * i + j] =
          d_camera[3 * i + j] + zero_unless(on, d_p[i] * m.mean[j] + by_J + d_direction[j] * camera.t[i]);
    }
    d_camera[9 + i] = d_camera[9 + i] + zero_unless(on, d_p[i] + dot(d_direction, R[i]));
  }
}

// One group in one camera: from the sums over its splats to the group, the camera and the ambient light.
OBBGS_INLINE void camera_backward(const Scene& s, const Group& group, const Model& m, const Camera& camera,
                                  const SplatSums& sums, int features, const float* means2d_in, float* means2d,
                                  float* added, GroupGradients& d, vf* d_camera, vf& d_ambient) {
  const Projection p(s, m, camera);
  const mask on = p.drawn & (vf(0.0f) < load(sums.lit));
  d.logit = d.logit + zero_unless(on, sums.get(kG) * (vf(1.0f) - m.opacity));
  const ScreenGradient screen(sums);
  group.put(means2d, 2, 0, screen.x);
  group.put(means2d, 2, 1, screen.y);
  vf d_x = screen.x, d_y = screen.y;
  if (means2d_in) {
    d_x = d_x + group.get(means2d_in, 2, 0);
    d_y = d_y + group.get(means2d_in, 2, 1);
  }
  vf R[3][3], d_U[2][3], d_p[3], d_direction[3];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) R[i][j] = camera.R[i][j];
  d_camera[12] = d_camera[12] + covariance_backward(s, m, p, on, screen, sums.get(kG), d.A, d_U);
  const vf d_depth = features > s.channels ? sums.get(kFirstFeature + s.channels) : vf(0.0f);
  point_backward(camera, p, R, d_x, d_y, d_depth, d_U, d_p);
  shading_backward(s, group, m, camera, sums, features, on, added, d, d_direction, d_ambient);
  pose_backward(m, camera, p, R, on, d_p, d_U, d_direction, d.mean, d_camera);
}

// Writes the gradients of a group's stored parameters.
OBBGS_INLINE void write_gradients(const Scene& s, const Group& group, const Model& m, GroupGradients& d,
                                  const SceneGradients& out) {
  for (int k = 0; k < 3; ++k) {
    vf d_scale = 0.0f;
    for (int i = 0; i < 3; ++i) {
      d_scale = d_scale + zero_unless(finite(m.A[i][k]), d.A[i][k] * m.A[i][k]);
      d.R[i][k] = d.R[i][k] + zero_unless(finite(m.scale[k]), d.A[i][k] * m.scale[k]);
    }
    group.put(out.means, 3, k, d.mean[k]);
    group.put(out.log_scales, 3, k, d_scale);
  }
  const vf w = m.quat[0], x = m.quat[1], y = m.quat[2], z = m.quat[3];
  const auto& R = d.R;
  const vf d_quat[4] = {
      (x * (R[2][1] - R[1][2]) + y * (R[0][2] - R[2][0]) + z * (R[1][0] - R[0][1])) * 2.0f,
      (y * (R[0][1] + R[1][0]) + z * (R[0][2] + R[2][0]) + w * (R[2][1] - R[1][2]) - x * (R[1][1] + R[2][2]) * 2.0f) *
          2.0f,
      (x * (R[0][1] + R[1][0]) + z * (R[1][2] + R[2][1]) + w * (R[0][2] - R[2][0]) - y * (R[0][0] + R[2][2]) * 2.0f) *
          2.0f,
      (x * (R[0][2] + R[2][0]) + y * (R[1][2] + R[2][1]) + w * (R[1][0] - R[0][1]) - z * (R[0][0] + R[1][1]) * 2.0f) *
          2.0f,
  };
  const vf radial = d_quat[0] * w + d_quat[1] * x + d_quat[2] * y + d_quat[3] * z;
  const mask normalised = m.usable & (vf(kMinNorm) < m.length);
  for (int i = 0; i < 4; ++i)
    group.put(out.quats, 4, i, zero_unless(normalised, (d_quat[i] - m.quat[i] * radial) / m.length));
  group.put(out.opacity_logits, 1, 0, d.logit);
  const int coefficients = s.sh_count * s.channels;
  for (int i = 0; i < coefficients; ++i) group.put(out.sh, coefficients, i, d.sh[i]);
}

// Adds up the chunks' camera gradients, [chunks, cameras, kCamera], in their order.
void write_camera_gradients(const Scene& s, int chunks, const std::vector<float>& parts, const SceneGradients& out) {
  for (int c = 0; c < s.cameras; ++c) {
    double total[kCamera] = {};
    for (int chunk = 0; chunk < chunks; ++chunk)
      for (int i = 0; i < kCamera; ++i) total[i] += parts[(size_t(chunk) * s.cameras + c) * kCamera + i];
    float* matrix = out.world_to_camera + 16 * c;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) matrix[4 * i + j] = float(total[3 * i + j]);
      matrix[4 * i + 3] = float(total[9 + i]);
      matrix[12 + i] = 0.0f;
    }
    matrix[15] = 0.0f;
    out.footprint_px2[c] = float(total[12]);
  }
}

}  // namespace

void project_backward(const Scene& s, const Frame& frame, const float* records, int features, const SceneGradients& out,
                      int threads) {
  const int chunks = (s.gaussians + kChunk - 1) / kChunk;
  const size_t n = s.gaussians;
  std::vector<Camera> cameras;
  cameras.reserve(s.cameras);
  for (int c = 0; c < s.cameras; ++c) cameras.emplace_back(s, c);
  std::vector<float> of_cameras(size_t(chunks) * s.cameras * kCamera), ambient(chunks);  // of each chunk
  parallel_for(chunks, worthwhile(threads, n * s.cameras, kSplatsPerThread), [&](int chunk) {
    std::vector<vf> d_cameras(size_t(s.cameras) * kCamera, vf(0.0f));
    vf d_ambient = 0.0f;
    const float* of_chunk = records + size_t(frame.first_record[chunk]) * kRecord;
    for (int first = chunk * kChunk; first < std::min(s.gaussians, (chunk + 1) * kChunk); first += kLanes) {
      const Group group(s, first);
      const Model m(s, group);
      GroupGradients d(s.sh_count * s.channels);
      for (int c = 0; c < s.cameras; ++c) {
        const size_t base = c * n;
        float* means2d = out.means2d + 2 * base;
        float* added = out.added ? out.added + base * s.channels : nullptr;
        const SplatSums sums(s, group, &frame.splats[base + first], of_chunk, out.means2d_in != nullptr,
                             out.pixels + base + first);
        if (sums.none) {
          std::fill_n(means2d + 2 * first, 2 * group.size, 0.0f);
          if (added) std::fill_n(added + size_t(first) * s.channels, group.size * s.channels, 0.0f);
          continue;
        }
        const float* means2d_in = out.means2d_in ? out.means2d_in + 2 * base : nullptr;
        camera_backward(s, group, m, cameras[c], sums, features, means2d_in, means2d, added, d,
                        &d_cameras[size_t(c) * kCamera], d_ambient);
      }
      write_gradients(s, group, m, d, out);
    }
    for (int i = 0; i < s.cameras * kCamera; ++i)
      of_cameras[size_t(chunk) * s.cameras * kCamera + i] = sum(d_cameras[i]);
    ambient[chunk] = sum(d_ambient);
  });
  double all_ambient = 0;
  for (const float part : ambient) all_ambient += part;
  *out.ambient = float(all_ambient);
  write_camera_gradients(s, chunks, of_cameras, out);
}

}  // namespace KERNEL
}  // namespace obbgs

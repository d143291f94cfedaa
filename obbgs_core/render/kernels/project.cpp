// Gaussians to splats: projection, opacity, radiance and the tiles that they touch.
#include <vector>

#include "machine/threads.h"
#include "pairs.h"
#include "projection.h"
#include "shading.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr float kHalfLog2E = 0.84932180f;  // sqrt(log2(e) / 2): turns the Cholesky factor of a conic into k1, k2, k3
constexpr float kReachMargin = 1.01f;      // covers rounding
constexpr float kWhole = 8e6f;             // larger floats are left as they are: nearly all of them are whole numbers

// Writes the projected means and radii of a group in one camera.
OBBGS_INLINE void write_means(const Group& group, const Projection& p, vf mx, vf my, float* means2d, float* radii) {
  const vf middle = (p.xx + p.yy) * 0.5f, spread = larger(fma(middle, middle, -p.determinant), 0.1f);
  group.put(means2d, 2, 0, mx);
  group.put(means2d, 2, 1, my);
  const vf radius = zero_unless(p.drawn, sqrt(middle + sqrt(spread)) * 3.0f);
  const vf whole = to_float(truncate(smaller(radius, kWhole)));
  const vf rounded_up = select(whole < radius, whole + 1.0f, whole);
  group.put(radii, 1, 0, larger(rounded_up, select(vf(kWhole) < radius, radius, 0.0f)));
}

// Writes the splats of a group in one camera, and a key for each that may reach the image; returns how many keys.
OBBGS_INLINE uint32_t write_splats(const Scene& s, const Group& group, const Model& model, const Camera& camera,
                                   const Projection& p, vf mx, vf my, uint32_t first_splat, Splat* splats,
                                   DepthKey* keys) {
  const vf level = log2(model.opacity), squared = larger(level - kLog2MinAlpha, 0.0f);
  const vf reach = sqrt(squared) * (kReachMargin / kHalfLog2E);
  const vf reach_x = reach * sqrt(p.xx), reach_y = reach * sqrt(p.yy);
  const mask in_x = (vf(0.0f) <= mx + reach_x) & (mx - reach_x <= vf(float(s.width)));
  const mask in_y = (vf(0.0f) <= my + reach_y) & (my - reach_y <= vf(float(s.height)));
  const mask seen = p.drawn & (vf(kMinAlpha) <= model.opacity) & finite(mx) & finite(my) & in_x & in_y;
  for (int l = 0; l < group.size; ++l) splats[l].records = 0;
  if (!any(seen)) return 0;
  const Shading shading(s, group, model, camera);
  const vf k1 = sqrt(p.yy / p.determinant) * kHalfLog2E, k2 = -(p.xy / p.yy * k1), k3 = vf(kHalfLog2E) / sqrt(p.yy);
  vf feature[kMaxFeatures];
  mask valid = seen;
  for (int f = 0; f < s.channels; ++f) {
    feature[f] = shading.radiance(f);
    valid = valid & finite(feature[f]);
  }
  feature[s.channels] = p.p[2];
  const vf flags = zero_unless(valid, 1.0f), cutoff = p.share * kMinAlpha;
  const vf lowered = s.peak_lowered ? level + log2(p.share) : level;
  uint32_t count = 0;
  for (int l = 0; l < group.size; ++l) {
    if (flags[l] == 0.0f) continue;
    Splat& splat = splats[l];
    splat.x = mx[l];
    splat.y = my[l];
    splat.k1 = k1[l];
    splat.k2 = k2[l];
    splat.k3 = k3[l];
    splat.level = lowered[l];
    splat.cutoff = cutoff[l];
    splat.reach = squared[l];
    for (int f = 0; f <= s.channels; ++f) splat.feature[f] = feature[f][l];
    keys[count] = {0, first_splat + uint32_t(l)};
    std::memcpy(&keys[count].depth_bits, &splat.feature[s.channels], 4);
    ++count;
  }
  return count;
}

}  // namespace

void project(const Scene& s, Frame& frame, float* means2d, float* radii, int threads) {
  const int chunks = (s.gaussians + kChunk - 1) / kChunk;
  const size_t n = s.gaussians, count = n * s.cameras;
  frame.splats.resize(count);
  frame.visible.resize(count);
  frame.found.assign(chunks, {});
  std::vector<uint32_t> visible(size_t(s.cameras) * chunks, 0);  // keys of each camera and chunk
  std::vector<Camera> cameras;
  cameras.reserve(s.cameras);
  for (int c = 0; c < s.cameras; ++c) cameras.emplace_back(s, c);
  parallel_for(chunks, worthwhile(threads, count, kSplatsPerThread), [&](int chunk) {
    for (int first = chunk * kChunk; first < std::min(s.gaussians, (chunk + 1) * kChunk); first += kLanes) {
      const Group group(s, first);
      const Model model(s, group);
      for (int c = 0; c < s.cameras; ++c) {
        const Camera& camera = cameras[c];
        const Projection p(s, model, camera);
        const vf mx = select(p.drawn, fma(p.x, camera.fx, camera.cx), camera.cx);
        const vf my = select(p.drawn, fma(p.y, camera.fy, camera.cy), camera.cy);
        const size_t base = c * n;
        write_means(group, p, mx, my, means2d + 2 * base, radii + base);
        uint32_t& keys = visible[size_t(c) * chunks + chunk];
        keys += write_splats(s, group, model, camera, p, mx, my, uint32_t(base + first), &frame.splats[base + first],
                             frame.visible.data() + base + size_t(chunk) * kChunk + keys);
      }
    }
    std::vector<Found>& found = frame.found[chunk];
    found.reserve(2 * kChunk * s.cameras);
    for (int c = 0; c < s.cameras; ++c)  // while the splats are in this core's cache
      for (uint32_t k = 0; k < visible[size_t(c) * chunks + chunk]; ++k) {
        const uint32_t index = frame.visible[c * n + size_t(chunk) * kChunk + k].splat;
        Splat& splat = frame.splats[index];
        splat.first_record = uint32_t(found.size());
        find_tiles(s, splat, index, found);
        splat.records = uint32_t(found.size()) - splat.first_record;
      }
  });
  frame.visible_count = 0;
  for (int c = 0; c < s.cameras; ++c)
    for (int chunk = 0; chunk < chunks; ++chunk) {  // closes the gaps between the chunks' keys
      const DepthKey* from = &frame.visible[c * n + size_t(chunk) * kChunk];
      const uint32_t keys = visible[size_t(c) * chunks + chunk];
      std::memmove(frame.visible.data() + frame.visible_count, from, keys * sizeof(DepthKey));
      frame.visible_count += keys;
    }
}

}  // namespace KERNEL
}  // namespace obbgs

// The published losses with their gradients in one pass, and Adam. The same in PyTorch is in losses.py and train/;
// tests compare the two. Parameters are cut into blocks of a fixed size, images into bands of rows (bands.h).
#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "bands.h"

namespace obbgs {

const RowLoops* loops = &portable::row_loops;

namespace {

constexpr size_t kBlockParameters = 1 << 15;
constexpr size_t kRepeatedRates = 1 << 10;  // a table that stays in the first cache

Window gaussian_window() {
  double sum = 0, values[kTaps];
  for (int k = 0; k < kTaps; ++k) sum += values[k] = std::exp(-0.5 * (k - kReach) * (k - kReach) / (1.5 * 1.5));
  Window w;
  for (int k = 0; k < kTaps; ++k) w.taps[k] = float(values[k] / sum);
  return w;
}

// Adds scale * slope * d SSIM / d a to the band's rows of `gradient` (when there is one); returns the sum of 1 - SSIM.
// a and b hold the image's rows as far as the band's windows reach; slope: of a by radiance.
double ssim_band(const Shape& shape, const Band& band, float scale, Rows& a, Rows& slope, Rows& b, float* gradient) {
  static const Window w = gaussian_window();
  const int n = shape.row(), c = shape.channels, reach = gradient ? kReach : 0;
  const int first = std::max(band.begin - reach, 0), last = std::min(band.end + reach, shape.height);
  const std::vector<float> outside_image(n, 0.0f);
  Rows columns(0, 4, n, kReach * c), by_mean(first, last, n), by_squares(first, last, n), by_product(first, last, n);
  std::vector<float> inside(n, 0.0f), halo(n);
  const float *rows_a[kTaps], *rows_b[kTaps];
  for (int y = first; y < last; ++y) {
    for (int k = 0; k < kTaps; ++k) {
      const int row = y + k - kReach;
      const bool outside = row < 0 || row >= shape.height;
      rows_a[k] = outside ? outside_image.data() : a[row];
      rows_b[k] = outside ? outside_image.data() : b[row];
    }
    loops->blur_down_products(n, w, rows_a, rows_b, columns[0], columns[1], columns[2], columns[3]);
    float* sums = y >= band.begin && y < band.end ? inside.data() : halo.data();
    loops->ssim_row(n, c, w, columns[0], columns[1], columns[2], columns[3], sums, by_mean[y], by_squares[y],
                    by_product[y]);
  }
  for (int y = band.begin; gradient && y < band.end; ++y) {
    Rows* slopes[3] = {&by_mean, &by_squares, &by_product};
    for (int s = 0; s < 3; ++s) {
      for (int k = 0; k < kTaps; ++k) {
        const int row = y + k - kReach;
        rows_a[k] = row < first || row >= last ? outside_image.data() : (*slopes[s])[row];
      }
      loops->blur_down(n, w, rows_a, columns[s]);
    }
    loops->ssim_gradient_row(n, c, w, scale, slope[y], columns[0], columns[1], columns[2], a[y], b[y],
                             gradient + size_t(y) * n);
  }
  return total(inside);
}

// (1 - ssim_weight) * mean |a - b| + ssim_weight * (1 - mean SSIM) + edge_weight * mean Sobel difference, where a is
// the prediction, clamped at 1 if wanted, and b the reading, in full scales above black; the residual is a - b.
double published(Array radiance, Array dn, Array gains, const SensorModel& s, double ssim_weight, double edge_weight,
                 bool clamped, Array residual, std::optional<Array> gradient, int threads) {
  const Shape shape = shape_of(radiance, "radiance");
  expect(dn, "dn", radiance.size());
  expect(gains, "gains", shape.count);
  expect(residual, "residual", radiance.size());
  if (gradient) expect(*gradient, "gradient", radiance.size());
  const float *r = radiance.data(), *d = dn.data(), *gain = gains.data();
  float *out = residual.data(), *g = gradient ? gradient->data() : nullptr;
  const double l1_scale = (1 - ssim_weight) / shape.values(), ssim_scale = ssim_weight / shape.values();
  const double edge_scale = edge_weight / shape.edges();
  nb::gil_scoped_release release;
  return sum_over_bands(shape, threads, [&](const Band& band) {
    const int n = shape.row();
    const size_t image = band.image * shape.image();
    const float per_dn = 1 / (s.white - s.black), most = clamped ? 1.0f : std::numeric_limits<float>::max();
    const int first = std::max(band.begin - 2 * kReach, 0), last = std::min(band.end + 2 * kReach, shape.height);
    Rows a(first, last, n), slope(first, last, n), b(first, last, n);  // slope: of a by radiance
    for (int y = first; y < last; ++y) {
      loops->clamped_row(n, r + image + size_t(y) * n, gain[band.image] * per_dn, most, a[y], slope[y]);
      loops->scaled_row(n, d + image + size_t(y) * n, s.black, per_dn, b[y]);
    }
    float* image_gradient = g ? g + image : nullptr;
    std::vector<float> sums(n, 0.0f), unwanted(n);
    for (int y = band.begin; y < band.end; ++y) {
      const size_t at = image + size_t(y) * n;
      float* by_radiance = g ? g + at : unwanted.data();
      loops->absolute_row(n, slope[y], a[y], b[y], out + at, sums.data(), by_radiance);
      loops->scale_row(n, float(l1_scale), by_radiance);
    }
    double sum = l1_scale * total(sums);
    if (ssim_weight != 0) sum += ssim_scale * ssim_band(shape, band, float(-ssim_scale), a, slope, b, image_gradient);
    if (edge_weight != 0)
      sum += edge_scale * edge_band(shape, band, n, float(edge_scale), image_gradient,
                                    [&](int y, float* difference, float* by_radiance) {
                                      loops->difference_row(n, a[y], b[y], difference);
                                      std::copy_n(slope[y], n, by_radiance);
                                    });
    return sum;
  });
}

// One Adam step of one parameter, in place. The rates already hold the bias correction; fewer than the numbers of the
// parameter repeat along it, one for each coefficient of a Gaussian or one for all.
void adam_step(Array parameter, Array gradient, Array first, Array second, Array rates, double b1, double b2,
               double eps, int threads) {
  const size_t n = parameter.size(), period = rates.size();
  expect(gradient, "gradient", n);
  expect(first, "first", n);
  expect(second, "second", n);
  if (period == 0 || n % period != 0)
    throw std::invalid_argument("rates: expected a number of them that divides " + std::to_string(n) + ", got " +
                                std::to_string(period));
  std::vector<float> repeated(period * std::max<size_t>(1, kRepeatedRates / period));
  for (size_t i = 0; i < repeated.size(); ++i) repeated[i] = rates.data()[i % period];
  float *p = parameter.data(), *m = first.data(), *v = second.data();
  const float* g = gradient.data();
  nb::gil_scoped_release release;
  const size_t tile = repeated.size(), block_size = tile * std::max<size_t>(1, kBlockParameters / tile);
  const int blocks = int((n + block_size - 1) / block_size);
  parallel_for(blocks, threads, [&](int block) {
    const size_t end = std::min(n, (size_t(block) + 1) * block_size);
    for (size_t at = size_t(block) * block_size; at < end; at += tile)
      loops->adam_block(std::min(tile, end - at), p + at, g + at, m + at, v + at, repeated.data(), float(1 - b1),
                        float(b2), float(1 - b2), float(eps));
  });
}

}  // namespace

void use_row_loops(const RowLoops& chosen) { loops = &chosen; }

}  // namespace obbgs

void bind_training(nb::module_& m) {
  using namespace nb::literals;
  // arrays that are filled in place must not be converted: the result would go into a copy
  m.def("published", &obbgs::published, "radiance"_a, "dn"_a, "gains"_a, "sensor"_a, "ssim_weight"_a, "edge_weight"_a,
        "clamped"_a, "residual"_a.noconvert(), "gradient"_a.none().noconvert(), "threads"_a);
  m.def("adam_step", &obbgs::adam_step, "parameter"_a.noconvert(), "gradient"_a, "first"_a.noconvert(),
        "second"_a.noconvert(), "rates"_a, "b1"_a, "b2"_a, "eps"_a, "threads"_a);
}

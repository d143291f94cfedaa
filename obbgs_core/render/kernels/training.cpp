// What a training step does to every pixel and every parameter besides rendering: the losses with their gradients in
// one pass, figures of the fit, and Adam. The same in PyTorch is in losses.py and train/; tests compare the two.
//
// Images are [count, height, width, channels] float32. Work is cut into bands of rows (or blocks of parameters) of a
// fixed size whose sums are added in order, so the result does not depend on the number of threads. The loops over each
// row are in rows.h, once for each instruction set.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "rows.h"
#include "threads.h"

namespace nb = nanobind;
using Array = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

namespace obbgs {
namespace {

const RowLoops* loops = &portable::row_loops;  // of the instruction set in use

constexpr int kBandRows = 40;
constexpr int kLikelihoodBandRows = 16;  // each band is as wide as what is drawn in it
constexpr size_t kBlockParameters = 1 << 15;
constexpr size_t kRepeatedRates = 1 << 10;  // a table that stays in the first cache

// ------------------------------------------------------------------------------------------------- bands of rows

struct Shape {
  int count, height, width, channels;
  int row() const { return width * channels; }
  size_t image() const { return size_t(height) * row(); }
  double values() const { return double(count) * height * row(); }
  double edges() const { return double(count) * (height - 2) * (width - 2) * channels; }
};

struct Band {
  int image, begin, end;
};  // rows begin .. end - 1

// Returns the sum of work(band) over all bands of all images, added in their order.
template <typename Sum = double, typename Work>
Sum sum_over_bands(const Shape& shape, int threads, Work work, int band_rows = kBandRows) {
  const int per_image = (shape.height + band_rows - 1) / band_rows;
  std::vector<Sum> parts(size_t(shape.count) * per_image);
  parallel_for(int(parts.size()), threads, [&](int i) {
    const int begin = i % per_image * band_rows;
    parts[i] = work(Band{i / per_image, begin, std::min(begin + band_rows, shape.height)});
  });
  return std::accumulate(parts.begin(), parts.end(), Sum{});
}

double total(const std::vector<float>& sums) { return std::accumulate(sums.begin(), sums.end(), 0.0); }

struct Span {
  int begin, end;
};  // columns begin .. end - 1

// Returns the columns of an image [height, width] that hold the values above zero (or NaN) of some rows, as far as
// these lie in it; empty where there are none.
Span drawn_columns(const Shape& shape, const float* image, int first, int last) {
  Span found{shape.width, 0};
  for (int y = std::max(first, 0); y < std::min(last, shape.height); ++y) {
    const float* row = image + size_t(y) * shape.width;
    for (int x = 0; x < found.begin; ++x)
      if (!(row[x] <= 0)) found.begin = x;
    for (int x = shape.width; x > found.end; --x)
      if (!(row[x - 1] <= 0)) found.end = x;
  }
  return found;
}

// A few rows of a padded image, kept by row number.
class Rows {
 public:
  Rows(int first, int last, int width, int margin = 0)
      : first_(first), stride_(width + 2 * margin), margin_(margin), values_(size_t(last - first) * stride_, 0.0f) {}
  float* operator[](int row) { return values_.data() + size_t(row - first_) * stride_ + margin_; }

 private:
  int first_, stride_, margin_;
  std::vector<float> values_;
};

// Adds scale * d (|Sx| + |Sy|) / d radiance to the band's rows of `gradient` (when there is one) and returns the sum of
// |Sx| + |Sy| over the band. fill(row, difference, slope) makes a row of differences and their slopes by radiance. Only
// `n` values of each row are looked at, and `gradient` begins with the first of them.
template <typename Fill>
double edge_band(const Shape& shape, const Band& band, int n, float scale, float* gradient, Fill fill) {
  const int c = shape.channels;
  const int first = std::max(band.begin - 2, 0), last = std::min(band.end + 2, shape.height);
  Rows difference(first, last, n), slope(first, last, n);
  for (int y = first; y < last; ++y) fill(y, difference[y], slope[y]);
  Rows sign_x(band.begin - 1, band.end + 1, n, c), sign_y(band.begin - 1, band.end + 1, n, c);
  std::vector<float> inside(n, 0.0f), halo(n);
  for (int y = std::max(band.begin - 1, 1); y < std::min(band.end + 1, shape.height - 1); ++y) {
    float* sums = y >= band.begin && y < band.end
                      ? inside.data()
                      : halo.data();  // the other rows are counted by the neighbouring bands
    loops->sobel_row(n, c, difference[y - 1], difference[y], difference[y + 1], sign_x[y], sign_y[y], sums);
  }
  for (int y = band.begin; gradient && y < band.end; ++y)
    loops->sobel_gradient_row(n, c, scale, sign_x[y - 1], sign_x[y], sign_x[y + 1], sign_y[y - 1], sign_y[y + 1],
                              slope[y], gradient + size_t(y) * shape.row());
  return total(inside);
}

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

// ------------------------------------------------------------------------------------------------ the interface to
// Python

Shape shape_of(const Array& images, const char* name) {
  if (images.ndim() != 4)
    throw std::invalid_argument(std::string(name) + ": expected [count, height, width, channels]");
  return {int(images.shape(0)), int(images.shape(1)), int(images.shape(2)), int(images.shape(3))};
}

void expect(const Array& array, const char* name, size_t count) {
  if (array.size() != count)
    throw std::invalid_argument(std::string(name) + ": expected " + std::to_string(count) + " numbers, got " +
                                std::to_string(array.size()));
}

// weight * mean robust penalty of the deviance residual + edge_weight * mean Sobel difference, stabilised scale.
// misfit_floors: of each image, see SensorModel. drawn: where it is zero no gradient is asked for; rows are cut to what
// is drawn in their band (and what its edges need), beyond which residual and gradient are 0 and nothing is added.
double likelihood(Array radiance, Array dn, Array gains, const SensorModel& s, Array misfit_floors, double weight,
                  double edge_weight, std::optional<Array> drawn, Array residual, std::optional<Array> gradient,
                  int threads) {
  const Shape shape = shape_of(radiance, "radiance");
  expect(dn, "dn", radiance.size());
  expect(gains, "gains", shape.count);
  expect(misfit_floors, "misfit_floors", shape.count);
  if (drawn) expect(*drawn, "drawn", radiance.size() / std::max(shape.channels, 1));
  expect(residual, "residual", radiance.size());
  if (gradient) expect(*gradient, "gradient", radiance.size());
  const float *r = radiance.data(), *d = dn.data(), *gain = gains.data(), *floors = misfit_floors.data();
  const float* opaque = drawn ? drawn->data() : nullptr;
  float *out = residual.data(), *g = gradient ? gradient->data() : nullptr;
  const double scale = weight / shape.values(), edge_scale = edge_weight / shape.edges();
  const auto at_a_clip = [&](float reading) { return reading <= 0 || reading >= s.white; };
  nb::gil_scoped_release release;
  const auto work = [&](const Band& band) {
    const size_t image = band.image * shape.image();
    const float t = gain[band.image];
    const int reach = edge_weight != 0 ? 2 : 0;  // of edges
    Span shown{0, shape.width};
    if (opaque) {
      shown = drawn_columns(shape, opaque + image / shape.channels, band.begin, band.end);
      const size_t from = image + size_t(band.begin) * shape.row(),
                   values = size_t(band.end - band.begin) * shape.row();
      std::fill_n(out + from, values, 0.0f);
      if (g) std::fill_n(g + from, values, 0.0f);
      if (shown.begin >= shown.end) return 0.0;
      shown = {std::max(shown.begin - reach, 0), std::min(shown.end + reach, shape.width)};
    }
    const int n = (shown.end - shown.begin) * shape.channels;
    const size_t first = image + size_t(shown.begin) * shape.channels;  // value of the image's first row
    SensorModel of_image = s;
    of_image.misfit_floor = floors[band.image];
    std::vector<float> penalty(n, 0.0f), unwanted(n);
    for (int y = band.begin; y < band.end; ++y) {
      const size_t at = first + size_t(y) * shape.row();
      float* slope = g ? g + at : unwanted.data();
      const bool clipped = std::any_of(d + at, d + at + n, at_a_clip);
      const auto row = s.root_averaged > 1 ? loops->averaged_likelihood_row
                       : clipped           ? loops->likelihood_row
                                           : loops->unclipped_likelihood_row;
      row(n, r + at, d + at, t, of_image, out + at, penalty.data(), slope);
      loops->scale_row(n, float(scale), slope);
    }
    double sum = scale * total(penalty);
    if (edge_weight != 0)
      sum += edge_scale * edge_band(shape, band, n, float(edge_scale), g ? g + first : nullptr,
                                    [&](int y, float* difference, float* slope) {
                                      const size_t at = first + size_t(y) * shape.row();
                                      loops->stabilised_row(n, r + at, d + at, t, s, difference, slope);
                                    });
    return sum;
  };
  return sum_over_bands(shape, threads, work, kLikelihoodBandRows);
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

struct Fit {
  double squares = 0, variances = 0, error = 0;  // see chi2_row; squared error everywhere
  Fit operator+(const Fit& other) const {
    return {squares + other.squares, variances + other.variances, error + other.error};
  }
};

// chi^2 where alpha > least_alpha (see chi2_row; NaN where that is nowhere), and mean squared error everywhere, full
// scale 1.
std::pair<double, double> fit(Array radiance, Array alpha, Array dn, Array gains, const SensorModel& s,
                              float least_alpha, int threads) {
  const Shape shape = shape_of(radiance, "radiance");
  expect(alpha, "alpha", radiance.size() / std::max(shape.channels, 1));
  expect(dn, "dn", radiance.size());
  expect(gains, "gains", shape.count);
  const float *r = radiance.data(), *opaque = alpha.data(), *d = dn.data(), *gain = gains.data();
  nb::gil_scoped_release release;
  const Fit sum = sum_over_bands<Fit>(shape, threads, [&](const Band& band) {
    const int n = shape.row(), c = shape.channels;
    std::vector<float> errors(n, 0.0f), squares(n, 0.0f), variances(n, 0.0f), seen(n);
    for (int y = band.begin; y < band.end; ++y) {
      const size_t at = band.image * shape.image() + size_t(y) * n;
      loops->squared_error_row(n, r + at, d + at, gain[band.image], s, errors.data());
      const float* row = opaque + at / c;
      int x0 = 0, x1 = shape.width;  // beyond x0 and x1 - 1 nothing is opaque enough
      while (x0 < x1 && !(row[x0] > least_alpha)) ++x0;
      while (x0 < x1 && !(row[x1 - 1] > least_alpha)) --x1;
      for (int x = x0; x < x1; ++x) std::fill_n(seen.begin() + x * c, c, row[x] > least_alpha ? 1.0f : 0.0f);
      loops->chi2_row((x1 - x0) * c, r + at + x0 * c, d + at + x0 * c, seen.data() + x0 * c, gain[band.image], s,
                      squares.data(), variances.data());
    }
    return Fit{total(squares), total(variances), total(errors)};
  });
  const double averaged = double(s.root_averaged) * s.root_averaged;
  return {averaged * sum.squares / sum.variances, sum.error / shape.values()};
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
  using obbgs::SensorModel;
  nb::class_<SensorModel>(m, "SensorModel")
      .def("__init__", [](SensorModel* self, double black_dn, double white_dn, double electrons_per_dn,
                          double read_noise_dn, double averaged_pixels, std::optional<double> misfit) {
        const double read_noise_e = read_noise_dn * electrons_per_dn;
        new (self) SensorModel{float(black_dn),
                               float(white_dn),
                               float(1 / electrons_per_dn),
                               float(electrons_per_dn),
                               float(read_noise_dn * read_noise_dn + 1.0 / 12),
                               float(3.0 / 8 + read_noise_e * read_noise_e),
                               float(std::sqrt(averaged_pixels)),
                               misfit ? float(*misfit) : -1.0f,
                               0.0f};
      });
  // arrays that are filled in place must not be converted: the result would go into a copy
  m.def("likelihood", &obbgs::likelihood, "radiance"_a, "dn"_a, "gains"_a, "sensor"_a, "misfit_floors"_a, "weight"_a,
        "edge_weight"_a, "drawn"_a.none(), "residual"_a.noconvert(), "gradient"_a.none().noconvert(), "threads"_a);
  m.def("published", &obbgs::published, "radiance"_a, "dn"_a, "gains"_a, "sensor"_a, "ssim_weight"_a, "edge_weight"_a,
        "clamped"_a, "residual"_a.noconvert(), "gradient"_a.none().noconvert(), "threads"_a);
  m.def("fit", &obbgs::fit, "radiance"_a, "alpha"_a, "dn"_a, "gains"_a, "sensor"_a, "least_alpha"_a, "threads"_a);
  m.def("adam_step", &obbgs::adam_step, "parameter"_a.noconvert(), "gradient"_a, "first"_a.noconvert(),
        "second"_a.noconvert(), "rates"_a, "b1"_a, "b2"_a, "eps"_a, "threads"_a);
}

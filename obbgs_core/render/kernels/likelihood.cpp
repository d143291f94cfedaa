// The robust likelihood of readings with its gradient in one pass, and figures of the fit. The same in PyTorch is in
// losses.py and misfit.py; tests compare the two.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "bands.h"

namespace obbgs {
namespace {

constexpr int kLikelihoodBandRows = 16;  // each band is as wide as what is drawn in it
constexpr int kChunkPixels = 16;         // of a row; readings at a clip, which are dear, come in runs

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

// The model's own error over some images: what SensorModel says of it, the floor of each image, and the weight by which
// the mean pull on the lit values stays that of the noise alone. It is that of `model_error` in misfit.py, on every so
// many pixels, `stride` apart; `own` of its variance goes with a value's own light. misfit: its share of the light, if
// it is known.
struct ModelError {
  float by_light = -1;
  std::vector<float> floors;
  double weight = 1;
};

ModelError model_error(const Shape& shape, const float* radiance, const float* gains, const SensorModel& s,
                       std::optional<double> misfit, double own, int stride) {
  ModelError error;
  error.floors.resize(shape.count);
  if (!misfit) return error;
  const double averaged = double(s.root_averaged) * s.root_averaged, share = averaged * *misfit * *misfit;
  error.by_light = float(share * own);
  struct Lit {
    double light2, variance;  // DN^2, the latter of the noise of a sensor pixel
  };
  double roots = 0;
  size_t all = 0;
  std::vector<Lit> lit;
  for (int i = 0; i < shape.count; ++i) {
    lit.clear();
    double sum = 0;
    for (int y = 0; y < shape.height; y += stride)
      for (int x = 0; x < shape.width; x += stride) {
        const float* pixel = radiance + i * shape.image() + (size_t(y) * shape.width + x) * shape.channels;
        for (int c = 0; c < shape.channels; ++c) {
          const double signal = double(gains[i]) * pixel[c], light = std::clamp<double>(signal, 0, s.white - s.black);
          const double variance = std::max(signal, 0.0) * s.dn_per_electron + s.read_variance;
          if (!(light * light > 4 * variance / averaged)) continue;
          lit.push_back({light * light, variance});
          sum += light * light;
        }
      }
    if (lit.empty()) continue;
    const double floor = share * (1 - own) * sum / double(lit.size());
    error.floors[i] = float(floor);
    for (const Lit& value : lit) roots += std::sqrt(1 + (share * own * value.light2 + floor) / value.variance);
    all += lit.size();
  }
  if (all > 0) error.weight = roots / double(all);
  return error;
}

// factor * (mean robust penalty of the deviance residual + edge_weight * mean Sobel difference, stabilised scale).
// misfit: the model's own error as a share of the light, if it is known, see `model_error`. drawn: where it is zero no
// gradient is asked for; rows are cut to what is drawn in their band (and what its edges need), beyond which, and in
// chunks of a row where nothing is drawn, the residual is 0 and nothing but edges is added.
double likelihood(Array radiance, Array dn, Array gains, const SensorModel& sensor, std::optional<double> misfit,
                  double own, int stride, double factor, double edge_weight, std::optional<Array> drawn, Array residual,
                  std::optional<Array> gradient, int threads) {
  const Shape shape = shape_of(radiance, "radiance");
  expect(dn, "dn", radiance.size());
  expect(gains, "gains", shape.count);
  if (stride < 1) throw std::invalid_argument("stride: expected at least 1, got " + std::to_string(stride));
  if (drawn) expect(*drawn, "drawn", radiance.size() / std::max(shape.channels, 1));
  expect(residual, "residual", radiance.size());
  if (gradient) expect(*gradient, "gradient", radiance.size());
  const float *r = radiance.data(), *d = dn.data(), *gain = gains.data();
  const float* opaque = drawn ? drawn->data() : nullptr;
  float *out = residual.data(), *g = gradient ? gradient->data() : nullptr;
  nb::gil_scoped_release release;
  SensorModel s = sensor;
  const ModelError error = model_error(shape, r, gain, s, misfit, own, stride);
  s.misfit = error.by_light;
  const double scale = factor * error.weight / shape.values(), edge_scale = factor * edge_weight / shape.edges();
  const auto at_a_clip = [&](float reading) { return reading <= 0 || reading >= s.white; };
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
    of_image.misfit_floor = error.floors[band.image];
    std::vector<float> penalty(n, 0.0f), unwanted(n);
    for (int y = band.begin; y < band.end; ++y)
      for (int x = shown.begin; x < shown.end; x += kChunkPixels) {
        const int pixels = std::min(kChunkPixels, shown.end - x), values = pixels * shape.channels;
        const size_t pixel = (size_t(band.image) * shape.height + y) * shape.width + x, at = pixel * shape.channels;
        if (opaque && std::none_of(opaque + pixel, opaque + pixel + pixels, [](float a) { return !(a <= 0); }))
          continue;
        const int offset = (x - shown.begin) * shape.channels;
        float* slope = g ? g + at : unwanted.data();
        const bool clipped = std::any_of(d + at, d + at + values, at_a_clip);
        const auto row = s.root_averaged > 1 ? loops->averaged_likelihood_row
                         : clipped           ? loops->likelihood_row
                                             : loops->unclipped_likelihood_row;
        row(values, r + at, d + at, t, of_image, out + at, penalty.data() + offset, slope);
        loops->scale_row(values, float(scale), slope);
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

struct Fit {
  double squares = 0, variances = 0, error = 0;  // see chi2_row; squared error everywhere
  double excess = 0, light = 0;                  // see misfit_row
  Fit operator+(const Fit& other) const {
    return {squares + other.squares, variances + other.variances, error + other.error, excess + other.excess,
            light + other.light};
  }
};

// chi^2 where alpha > least_alpha (see chi2_row; NaN where that is nowhere), the mean squared error everywhere, full
// scale 1, and the squared misfit as `relative_misfit` in misfit.py has it, not below zero (NaN where nothing is lit).
std::tuple<double, double, double> fit(Array radiance, Array alpha, Array dn, Array gains, const SensorModel& s,
                                       float least_alpha, int threads) {
  const Shape shape = shape_of(radiance, "radiance");
  expect(alpha, "alpha", radiance.size() / std::max(shape.channels, 1));
  expect(dn, "dn", radiance.size());
  expect(gains, "gains", shape.count);
  const float *r = radiance.data(), *opaque = alpha.data(), *d = dn.data(), *gain = gains.data();
  nb::gil_scoped_release release;
  const Fit sum = sum_over_bands<Fit>(shape, threads, [&](const Band& band) {
    const int n = shape.row(), c = shape.channels;
    std::vector<float> errors(n, 0.0f), squares(n, 0.0f), variances(n, 0.0f), seen(n), excess(n, 0.0f), light(n, 0.0f);
    for (int y = band.begin; y < band.end; ++y) {
      const size_t at = band.image * shape.image() + size_t(y) * n;
      loops->squared_error_row(n, r + at, d + at, gain[band.image], s, errors.data());
      loops->misfit_row(n, r + at, d + at, gain[band.image], s, excess.data(), light.data());
      const float* row = opaque + at / c;
      int x0 = 0, x1 = shape.width;  // beyond x0 and x1 - 1 nothing is opaque enough
      while (x0 < x1 && !(row[x0] > least_alpha)) ++x0;
      while (x0 < x1 && !(row[x1 - 1] > least_alpha)) --x1;
      for (int x = x0; x < x1; ++x) std::fill_n(seen.begin() + x * c, c, row[x] > least_alpha ? 1.0f : 0.0f);
      loops->chi2_row((x1 - x0) * c, r + at + x0 * c, d + at + x0 * c, seen.data() + x0 * c, gain[band.image], s,
                      squares.data(), variances.data());
    }
    return Fit{total(squares), total(variances), total(errors), total(excess), total(light)};
  });
  const double averaged = double(s.root_averaged) * s.root_averaged, misfit2 = sum.excess / sum.light;
  return {averaged * sum.squares / sum.variances, sum.error / shape.values(), misfit2 < 0 ? 0 : misfit2};
}

}  // namespace
}  // namespace obbgs

void bind_likelihood(nb::module_& m) {
  using namespace nb::literals;
  using obbgs::SensorModel;
  nb::class_<SensorModel>(m, "SensorModel")
      .def("__init__", [](SensorModel* self, double black_dn, double white_dn, double electrons_per_dn,
                          double read_noise_dn, double averaged_pixels) {
        const double read_noise_e = read_noise_dn * electrons_per_dn;
        new (self) SensorModel{float(black_dn),
                               float(white_dn),
                               float(1 / electrons_per_dn),
                               float(electrons_per_dn),
                               float(read_noise_dn * read_noise_dn + 1.0 / 12),
                               float(3.0 / 8 + read_noise_e * read_noise_e),
                               float(std::sqrt(averaged_pixels)),
                               -1.0f,
                               0.0f};
      });
  // arrays that are filled in place must not be converted: the result would go into a copy
  m.def("likelihood", &obbgs::likelihood, "radiance"_a, "dn"_a, "gains"_a, "sensor"_a, "misfit"_a.none(), "own"_a,
        "stride"_a, "factor"_a, "edge_weight"_a, "drawn"_a.none(), "residual"_a.noconvert(),
        "gradient"_a.none().noconvert(), "threads"_a);
  m.def("fit", &obbgs::fit, "radiance"_a, "alpha"_a, "dn"_a, "gains"_a, "sensor"_a, "least_alpha"_a, "threads"_a);
}

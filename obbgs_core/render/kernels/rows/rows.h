// Loops over one row of an image (or one block of parameters) that the compiler vectorises: losses, gradients, Adam;
// those of readings are in likelihood_rows.h.
// Rows hold width * channels values, channels interleaved: a pixel's neighbour is `c` (channels) values away.
// Compiled once for each instruction set, in rows.cpp; likelihood.cpp and training.cpp call them through RowLoops. No
// loop adds up across lanes and a*b + c is never contracted, so every instruction set gives the same bits. Compile with
// -fno-math-errno -fno-trapping-math: square roots and conditions are scalar without them.
#pragma once
#include <cmath>
#include <cstddef>

#include "likelihood_rows.h"

namespace obbgs {

constexpr int kReach = 5, kTaps = 2 * kReach + 1;  // SSIM window of Wang et al. 2004: 11 pixels, sigma 1.5
constexpr float kSsimC1 = 1e-4f, kSsimC2 = 9e-4f;  // (0.01)^2, (0.03)^2

struct Window {
  float taps[kTaps];
};

namespace rows {
namespace {

void difference_row(int n, const float* __restrict a, const float* __restrict b, float* __restrict difference) {
  for (int x = 0; x < n; ++x) difference[x] = a[x] - b[x];
}

inline float sign(float x) { return x > 0 ? 1.0f : (x < 0 ? -1.0f : x); }  // keeps NaN

// Signs of the Sobel derivatives at the pixels of one row that have both neighbours; |dx| + |dy| goes to `sums`.
// up, mid, down: three rows of differences; n: width * channels; c: channels.
void sobel_row(int n, int c, const float* __restrict up, const float* __restrict mid, const float* __restrict down,
               float* __restrict sign_x, float* __restrict sign_y, float* __restrict sums) {
  for (int x = c; x < n - c; ++x) {
    const float dx = (up[x + c] + 2 * mid[x + c] + down[x + c]) - (up[x - c] + 2 * mid[x - c] + down[x - c]);
    const float dy = (down[x - c] + 2 * down[x] + down[x + c]) - (up[x - c] + 2 * up[x] + up[x + c]);
    sign_x[x] = sign(dx);
    sign_y[x] = sign(dy);
    sums[x] += std::fabs(dx) + std::fabs(dy);
  }
}

// gradient += scale * slope * (Sobel transposed of the signs); rows of signs have a zero margin of c on both sides.
void sobel_gradient_row(int n, int c, float scale, const float* __restrict x_up, const float* __restrict x_mid,
                        const float* __restrict x_down, const float* __restrict y_up, const float* __restrict y_down,
                        const float* __restrict slope, float* __restrict gradient) {
  for (int x = 0; x < n; ++x) {
    const float left = x_up[x - c] + 2 * x_mid[x - c] + x_down[x - c];
    const float right = x_up[x + c] + 2 * x_mid[x + c] + x_down[x + c];
    const float above = y_up[x - c] + 2 * y_up[x] + y_up[x + c];
    const float below = y_down[x - c] + 2 * y_down[x] + y_down[x + c];
    gradient[x] += scale * slope[x] * (left - right + above - below);
  }
}

// Gaussian sums down the columns of 11 rows: of a, b, a^2 + b^2 and a b.
void blur_down_products(int n, const Window w, const float* const* a, const float* const* b, float* __restrict out_a,
                        float* __restrict out_b, float* __restrict out_squares, float* __restrict out_product) {
  for (int x = 0; x < n; ++x) {
    float sum_a = 0, sum_b = 0, squares = 0, product = 0;
#pragma GCC unroll 11
    for (int k = 0; k < kTaps; ++k) {
      const float wa = w.taps[k] * a[k][x], wb = w.taps[k] * b[k][x];
      sum_a += wa;
      sum_b += wb;
      squares += wa * a[k][x] + wb * b[k][x];
      product += wa * b[k][x];
    }
    out_a[x] = sum_a;
    out_b[x] = sum_b;
    out_squares[x] = squares;
    out_product[x] = product;
  }
}

void blur_down(int n, const Window w, const float* const* rows, float* __restrict out) {
  for (int x = 0; x < n; ++x) {
    float sum = 0;
#pragma GCC unroll 11
    for (int k = 0; k < kTaps; ++k) sum += w.taps[k] * rows[k][x];
    out[x] = sum;
  }
}

// Gaussian sum along the row; the row has a zero margin of kReach * c on both sides.
inline float blur_along(const float* row, int c, const Window& w) {
  float sum = 0;
#pragma GCC unroll 11
  for (int k = 0; k < kTaps; ++k) sum += w.taps[k] * row[(k - kReach) * c];
  return sum;
}

// From columns already summed: 1 - SSIM (added to `sums`) and the slopes of SSIM by the blurred a, a^2 + b^2 and a b.
void ssim_row(int n, int c, const Window w, const float* __restrict column_a, const float* __restrict column_b,
              const float* __restrict column_squares, const float* __restrict column_product, float* __restrict sums,
              float* __restrict by_mean, float* __restrict by_squares, float* __restrict by_product) {
  for (int x = 0; x < n; ++x) {
    const float a = blur_along(column_a + x, c, w), b = blur_along(column_b + x, c, w);
    const float squares = blur_along(column_squares + x, c, w), product = blur_along(column_product + x, c, w);
    const float l1 = 2 * a * b + kSsimC1, l2 = a * a + b * b + kSsimC1;                        // luminance l1 / l2
    const float s1 = 2 * (product - a * b) + kSsimC2, s2 = squares - a * a - b * b + kSsimC2;  // structure s1 / s2
    const float inverse = 1.0f / (l2 * s2), ssim = l1 * s1 * inverse;
    sums[x] += 1.0f - ssim;
    by_mean[x] = 2 * (b * (s1 - l1) * inverse + a * ssim * (l2 - s2) * inverse);
    by_squares[x] = -ssim * l2 * inverse;
    by_product[x] = 2 * l1 * inverse;
  }
}

// gradient += scale * slope * d SSIM / d a, from the three slopes of SSIM summed down the columns.
void ssim_gradient_row(int n, int c, const Window w, float scale, const float* __restrict slope,
                       const float* __restrict by_mean, const float* __restrict by_squares,
                       const float* __restrict by_product, const float* __restrict a, const float* __restrict b,
                       float* __restrict gradient) {
  for (int x = 0; x < n; ++x)
    gradient[x] += scale * slope[x] *
                   (blur_along(by_mean + x, c, w) + 2 * a[x] * blur_along(by_squares + x, c, w) +
                    b[x] * blur_along(by_product + x, c, w));
}

// difference = a - b; its size goes to `sums`; gradient = sign(difference) * slope.
void absolute_row(int n, const float* __restrict slope, const float* __restrict a, const float* __restrict b,
                  float* __restrict difference, float* __restrict sums, float* __restrict gradient) {
  for (int x = 0; x < n; ++x) {
    const float d = a[x] - b[x];
    difference[x] = d;
    sums[x] += std::fabs(d);
    gradient[x] = sign(d) * slope[x];
  }
}

// A prediction row * gain clamped at `most`, and `slope`: its derivative by the row. What is not finite becomes NaN.
void clamped_row(int n, const float* __restrict row, float gain, float most, float* __restrict clamped,
                 float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    const float value = row[x] * gain;
    clamped[x] = value > most ? most + 0 * value : value;
    slope[x] = value > most ? 0.0f : gain;
  }
}

// scaled = (row - zero) * gain
void scaled_row(int n, const float* __restrict row, float zero, float gain, float* __restrict scaled) {
  for (int x = 0; x < n; ++x) scaled[x] = (row[x] - zero) * gain;
}

void scale_row(int n, float scale, float* __restrict row) {
  for (int x = 0; x < n; ++x) row[x] *= scale;
}

void adam_block(size_t n, float* __restrict parameter, const float* __restrict gradient, float* __restrict first,
                float* __restrict second, const float* __restrict rates, float one_minus_b1, float b2,
                float one_minus_b2, float eps) {
  for (size_t i = 0; i < n; ++i) {
    const float g = gradient[i];
    first[i] += one_minus_b1 * (g - first[i]);
    second[i] = b2 * second[i] + one_minus_b2 * g * g;
    parameter[i] -= rates[i] * first[i] / (std::sqrt(second[i]) + eps);
  }
}

}  // namespace
}  // namespace rows

// The loops above that are called from training.cpp.
#define OBBGS_ROW_LOOPS(each)                                                                                          \
  each(likelihood_row) each(unclipped_likelihood_row) each(averaged_likelihood_row) each(chi2_row) each(misfit_row)    \
      each(stabilised_row) each(difference_row) each(sobel_row) each(sobel_gradient_row) each(blur_down_products)      \
          each(blur_down) each(ssim_row) each(ssim_gradient_row) each(absolute_row) each(clamped_row) each(scaled_row) \
              each(scale_row) each(squared_error_row) each(adam_block)

struct RowLoops {  // pointers to the loops of one instruction set; rows.cpp fills it
#define OBBGS_MEMBER(name) decltype(&rows::name) name;
  OBBGS_ROW_LOOPS(OBBGS_MEMBER)
#undef OBBGS_MEMBER
};
namespace portable {
extern const RowLoops row_loops;
}
namespace avx2 {
extern const RowLoops row_loops;
}
namespace avx512 {
extern const RowLoops row_loops;
}

void use_row_loops(const RowLoops& loops);  // from now on; training.cpp

}  // namespace obbgs

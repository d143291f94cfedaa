// Loops over one row of readings: their robust likelihood with its gradient, and figures of the fit. See rows.h.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

namespace obbgs {

constexpr float kKnee = 2;       // sigma, where the Charbonnier penalty turns from square to linear
constexpr float kTail = 3;       // sigma, where the Cauchy penalty turns from square to logarithm
constexpr float kHalfDn = 0.5f;  // rounding: a reading of 0 means a signal below this

struct SensorModel {
  float black, white, dn_per_electron, electrons_per_dn;
  float read_variance;   // DN^2, quantisation included
  float anscombe_floor;  // electrons^2
  float root_averaged;   // sqrt of the sensor pixels in one pixel: averaging shrinks the noise
  float misfit;          // variance of the model's own error over the squared light; negative: not known
  float misfit_floor;    // DN^2, what it is beside that everywhere in a picture; both times the sensor pixels in one
};

namespace rows {
namespace {

// exp(x) for -41 <= x <= 0, relative error 2e-7.
inline float exp_negative(float x) {
  const float t = x * 1.44269504f;
  const float bounded = t >= -60.0f ? t : -60.0f;  // NaN has no integer; below, f and so the result are still NaN
  const int32_t n = int32_t(bounded - 0.5f);       // truncation towards zero of a negative number rounds it
  const float f = (t - float(n)) * 0.693147181f;
  float p = f * 1.3888889e-3f + 8.3333333e-3f;
  p = p * f + 4.1666667e-2f;
  p = p * f + 1.6666667e-1f;
  p = p * f + 0.5f;
  p = p * f + 1.0f;
  p = p * f + 1.0f;
  const int32_t bits = (n + 127) << 23;
  float scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return p * scale;
}

// erfc(u) exp(u^2) for 0 <= u <= 6.4: our least-squares fit to scipy.special.erfcx, relative error 3e-7 in float32.
inline float scaled_erfc(float u) {
  const float t = 1.0f / (1.0f + 0.4f * u);
  float p = 0.0833209604f * t - 0.442234159f;
  p = p * t + 0.792480409f;
  p = p * t - 0.511070251f;
  p = p * t + 0.514995456f;
  p = p * t + 0.088318862f;
  p = p * t + 0.251530409f;
  p = p * t + 0.22248739f;
  return p * t + 1.70917133e-4f;
}

// log(x) for 0 < x < 1e30, of x and x - 1 (which may be known more exactly), relative error 2e-7: the series of atanh
// of a mantissa in 0.7 .. 1.4.
inline float log_positive(float x, float x_minus_1) {
  int32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  const int32_t exponent = (bits - 0x3f3504f3) >> 23;  // of x over the root of one half
  bits -= exponent * (1 << 23);
  float m;
  std::memcpy(&m, &bits, sizeof m);
  const float s = (exponent == 0 ? x_minus_1 : m - 1.0f) / (m + 1.0f), w = s * s;
  float p = w * 0.111111111f + 0.142857143f;
  p = p * w + 0.2f;
  p = p * w + 0.333333333f;
  return 2.0f * s * (p * w + 1.0f) + float(exponent) * 0.693147181f;
}

// The normal distribution at z: its density, and Phi(-|z|) with 0 beyond 9.
struct Normal {
  float density, tail;
};
inline Normal normal(float z) {
  float u = std::fabs(z) * 0.707106781f;
  u = u > 6.36396103f ? 6.36396103f : u;
  const float bell = exp_negative(-u * u);
  return {0.39894228f * bell, u < 6.36396103f ? 0.5f * bell * scaled_erfc(u) : 0.0f};
}

// The unclipped expected reading of a signal, DN, and one over the deviation of its noise.
inline float expected_dn(float signal, const SensorModel& s, float& inverse_sigma) {
  inverse_sigma = 1.0f / std::sqrt((signal > 0 ? signal : 0) * s.dn_per_electron + s.read_variance);
  return s.black + signal;
}

// Robust penalty of a squared residual; its slope is residual / q. Where the model's own error is not known:
// Charbonnier, knee^2 (q - 1) without the cancellation, q = sqrt(1 + (r / knee)^2). Otherwise Cauchy, tail^2 / 2
// log(q), q = 1 + (r / tail)^2, of residuals over both errors: `share` is the noise's share of their deviation.
template <bool known>
inline float robust(float& squared, float signal, float inverse_sigma, const SensorModel& s, float& share, float& q) {
  if (!known) {
    share = 1.0f;
    q = std::sqrt(1.0f + squared * (1.0f / (kKnee * kKnee)));
    return squared / (q + 1.0f);
  }
  const float seen = signal < 0 ? 0.0f : (signal > s.white - s.black ? s.white - s.black : signal);
  share = 1.0f / std::sqrt(1.0f + (s.misfit * seen * seen + s.misfit_floor) * inverse_sigma * inverse_sigma);
  squared *= share * share;
  const float w = squared * (1.0f / (kTail * kTail)), bounded = w < 1e29f ? w : 1e29f + 0 * w;
  q = 1.0f + w;
  return 0.5f * kTail * kTail * log_positive(1.0f + bounded, bounded);
}

// Deviance residual of one row of sensor pixels, its robust penalty (added to `penalty`), and d penalty / d radiance.
// A reading at a clip has the probability Phi(b) of lying beyond it, b: the prediction's distance from it in sigma.
template <bool known>
void likelihood(int n, const float* __restrict radiance, const float* __restrict dn, float gain, const SensorModel s,
                float* __restrict residual, float* __restrict penalty, float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const bool saturated = dn[x] >= s.white, clipped = saturated || dn[x] <= 0;
    const float b = (saturated ? expected - (s.white - kHalfDn) : kHalfDn - expected) * inverse_sigma;
    // -2 log Phi(b) and phi(b) / Phi(b), by the tail over its bell where Phi is small; past 9 sigma the tail's
    // asymptote
    float u = std::fabs(b) * 0.707106781f;
    u = u > 6.36396103f ? 6.36396103f : u;
    const float bell = exp_negative(-u * u), size = std::fabs(b), far = 1.0f / (size > 9.0f ? size : 9.0f),
                i = far * far;
    const float asymptote = 0.39894228f * far * (1.0f - i * (1.0f - 3.0f * i * (1.0f - 5.0f * i)));
    const float scaled = b < -9.0f ? asymptote : 0.5f * scaled_erfc(u);
    const float phi = b < 0 ? scaled : 1.0f - bell * scaled;  // over the bell below zero
    const float phi_minus_1 = b < 0 ? scaled - 1.0f : -bell * scaled;
    const float deviance = (b < 0 ? b * b : 0.0f) - 2.0f * log_positive(phi, phi_minus_1);
    const float hazard = 0.39894228f * (b < 0 ? 1.0f : bell) / phi;
    const float z = (expected - dn[x]) * inverse_sigma;
    float squared = clipped ? (deviance > 0 ? deviance : 0.0f) + 0 * z : z * z;  // NaN stays NaN
    float q, share;
    penalty[x] += robust<known>(squared, expected - s.black, inverse_sigma, s, share, q);
    const float root = std::sqrt(squared);
    residual[x] = clipped ? (saturated ? -root : root) : z * share;
    slope[x] = (clipped ? (saturated ? -hazard : hazard) : z) / q * inverse_sigma * gain * share * share;
  }
}

// The same, bit for bit, where no reading of the row lies at a clip.
template <bool known>
void unclipped_likelihood(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                          const SensorModel s, float* __restrict residual, float* __restrict penalty,
                          float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma, q, share;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const float z = (expected - dn[x]) * inverse_sigma;
    float squared = z * z;
    penalty[x] += robust<known>(squared, expected - s.black, inverse_sigma, s, share, q);
    residual[x] = z * share;
    slope[x] = z / q * inverse_sigma * gain * share * share;
  }
}

// The same for means of several sensor pixels: expectation of readings clipped at zero, normal noise, saturated means
// fitted by any brighter prediction.
template <bool known>
void averaged_likelihood(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                         const SensorModel s, float* __restrict residual, float* __restrict penalty,
                         float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const float z = expected * inverse_sigma;
    const Normal at_zero = normal(z);
    const float below = z < 0 ? at_zero.tail : 1.0f - at_zero.tail;  // also d clipped mean / d expected
    float r = (expected * below - dn[x]) * inverse_sigma + at_zero.density;
    const bool censored = dn[x] >= s.white && r > 0;
    r = censored ? 0.0f : r * s.root_averaged;
    float q, share, squared = r * r;
    penalty[x] += robust<known>(squared, expected - s.black, inverse_sigma, s, share, q);
    residual[x] = r * share;
    slope[x] = censored ? 0.0f : r / q * below * inverse_sigma * gain * s.root_averaged * share * share;
  }
}

// The three of them, with the model's own error or without.
#define OBBGS_KNOWN_OR_NOT(name)                                                                                   \
  void name##_row(int n, const float* radiance, const float* dn, float gain, const SensorModel s, float* residual, \
                  float* penalty, float* slope) {                                                                  \
    (s.misfit >= 0 ? name<true> : name<false>)(n, radiance, dn, gain, s, residual, penalty, slope);                \
  }
OBBGS_KNOWN_OR_NOT(likelihood)
OBBGS_KNOWN_OR_NOT(unclipped_likelihood)
OBBGS_KNOWN_OR_NOT(averaged_likelihood)
#undef OBBGS_KNOWN_OR_NOT

// Squared differences of readings and their expectation, and the variance of the readings, both over that of the
// noise, times `seen` (0 or 1). A saturated mean of several pixels is left out.
void chi2_row(int n, const float* __restrict radiance, const float* __restrict dn, const float* __restrict seen,
              float gain, const SensorModel s, float* __restrict squares, float* __restrict variances) {
  for (int x = 0; x < n; ++x) {
    float inverse_sigma;
    const float expected = expected_dn(gain * radiance[x], s, inverse_sigma);
    const float low = -expected * inverse_sigma, high = (s.white - expected) * inverse_sigma;
    const Normal at_low = normal(low), at_high = normal(high);
    const float below = low < 0 ? at_low.tail : 1.0f - at_low.tail;
    const float above = high > 0 ? at_high.tail : 1.0f - at_high.tail;
    const float lifted = low * below + at_low.density, lowered = at_high.density - high * above;
    const float shift = lifted - lowered;
    const float inside = 1.0f - below - above + low * at_low.density - high * at_high.density;
    float spread = inside + low * low * below + high * high * above - shift * shift;
    spread = (below >= 1.0f || above >= 1.0f || spread < 0) ? 0.0f : spread;  // always clipped: no variance
    float r = (expected - dn[x]) * inverse_sigma + shift;
    r = above >= 1.0f ? (s.white - dn[x]) * inverse_sigma : (below >= 1.0f ? -dn[x] * inverse_sigma : r);
    const float counts = s.root_averaged == 1.0f || dn[x] < s.white ? seen[x] : 0.0f;
    squares[x] += counts * r * r;
    variances[x] += counts * spread;
  }
}

// Prediction minus reading on the variance-stabilised scale, prediction clamped at white, and its slope by radiance.
void stabilised_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                    const SensorModel s, float* __restrict difference, float* __restrict slope) {
  for (int x = 0; x < n; ++x) {
    const float signal = gain * radiance[x], most = s.white - s.black;
    const float predicted = (signal > most ? most : signal) * s.electrons_per_dn;
    const float read = (dn[x] - s.black) * s.electrons_per_dn;
    // 2(sqrt(p + floor) - sqrt(r + floor)) without the cancellation where the floor is large; roots of 0.001 at least
    const float least = 1e-3f - s.anscombe_floor;
    const float p = predicted < least ? least : predicted, r = read < least ? least : read;
    const float root = std::sqrt(p + s.anscombe_floor < 1e-3f ? 1e-3f : p + s.anscombe_floor);
    difference[x] = 2 * (p - r) / (root + std::sqrt(r + s.anscombe_floor < 1e-3f ? 1e-3f : r + s.anscombe_floor));
    slope[x] = (signal > most || predicted < least) ? 0.0f : s.electrons_per_dn * gain / root;
  }
}

// Squared differences of the reading and the prediction as the sensor would show it, for PSNR.
void squared_error_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain,
                       const SensorModel s, float* __restrict sums) {
  for (int x = 0; x < n; ++x) {
    const float expected = s.black + gain * radiance[x];
    const float error = ((expected > s.white ? s.white : expected) - dn[x]) / s.white;
    sums[x] += error * error;
  }
}

// What the squared differences of readings and their expectation exceed the noise by, and the squared light, where a
// value is lit above twice the noise and not saturated.
void misfit_row(int n, const float* __restrict radiance, const float* __restrict dn, float gain, const SensorModel s,
                float* __restrict excess, float* __restrict light) {
  const float per_averaged = 1.0f / (s.root_averaged * s.root_averaged);
  for (int x = 0; x < n; ++x) {
    const float signal = gain * radiance[x], difference = s.black + signal - dn[x], squared = signal * signal;
    const float variance = ((signal > 0 ? signal : 0) * s.dn_per_electron + s.read_variance) * per_averaged;
    const bool counts = signal > 0 && squared > 4 * variance && dn[x] < s.white;
    excess[x] += counts ? difference * difference - variance : 0.0f;
    light[x] += counts ? squared : 0.0f;
  }
}

}  // namespace
}  // namespace rows
}  // namespace obbgs

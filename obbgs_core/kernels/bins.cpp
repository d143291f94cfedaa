// Depth order and binning: one radix sort of all visible Gaussians, then stable binning into tiles.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <thread>

#include "rasterizer.h"

namespace obbgs {
namespace {

// Stable least-significant-digit radix sort of indices by positive float keys.
std::vector<uint32_t> sort_by_depth(const std::vector<uint32_t>& visible, const float* depths) {
  struct Item { uint32_t key, index; };
  std::vector<Item> items(visible.size()), other(visible.size());
  for (size_t i = 0; i < visible.size(); ++i) {
    std::memcpy(&items[i].key, &depths[visible[i]], 4);  // bits of positive floats are ordered like their values
    items[i].index = visible[i];
  }
  for (int shift = 0; shift < 32; shift += 11) {
    uint32_t begin[2049] = {};
    for (const Item& item : items) ++begin[((item.key >> shift) & 2047) + 1];
    for (int d = 0; d < 2048; ++d) begin[d + 1] += begin[d];
    for (const Item& item : items) other[begin[(item.key >> shift) & 2047]++] = item;
    items.swap(other);
  }
  std::vector<uint32_t> order(items.size());
  for (size_t i = 0; i < items.size(); ++i) order[i] = items[i].index;
  return order;
}

}  // namespace

Bins bin(const Splats& s, int width, int height) {
  Bins bins;
  bins.width = width;
  bins.height = height;
  bins.tiles_x = (width + kTile - 1) / kTile;
  bins.tiles_y = (height + kTile - 1) / kTile;
  std::vector<uint32_t> visible;
  for (int i = 0; i < s.count; ++i)
    if (s.depths[i] > 0 && s.opacities[i] >= kMinAlpha) visible.push_back(i);
  const std::vector<uint32_t> order = sort_by_depth(visible, s.depths);

  struct TilePair { uint32_t tile; Pair pair; };
  std::vector<TilePair> found;
  found.reserve(order.size() * 2);
  const int blocks_x = (width + kBlock - 1) / kBlock, blocks_y = (height + kBlock - 1) / kBlock;
  std::vector<uint64_t> row_masks(bins.tiles_x);
  std::vector<uint32_t> records(s.count, 0);
  for (uint32_t i : order) {
    const float mx = s.means2d[2 * i], my = s.means2d[2 * i + 1];
    const float a = s.conics[3 * i], b = s.conics[3 * i + 1], c = s.conics[3 * i + 2];
    const float q = 2 * std::log(s.opacities[i] / kMinAlpha);  // alpha >= kMinAlpha where d^T conic d <= q
    const float det = a * c - b * b;
    if (!(det > 0 && a > 0 && c > 0) || !std::isfinite(mx) || !std::isfinite(my)) continue;
    const float reach_y = std::sqrt(q * a / det), reach_x = std::sqrt(q * c / det);
    if (mx + reach_x < 0 || mx - reach_x > width || my + reach_y < 0 || my - reach_y > height) continue;
    const float dy_right = -b / c * reach_x;  // where the ellipse is farthest right; the left point mirrors it
    const int band0 = std::max(0, int(std::floor((my - reach_y - 0.5f) / kBlock)));
    const int band1 = std::min(blocks_y - 1, int(std::floor((my + reach_y) / kBlock)));
    for (int tile_y = band0 / 8; tile_y <= band1 / 8; ++tile_y) {
      int tile_x0 = bins.tiles_x, tile_x1 = -1;
      std::fill(row_masks.begin(), row_masks.end(), 0);
      for (int band = std::max(band0, tile_y * 8); band <= std::min(band1, tile_y * 8 + 7); ++band) {
        // the ellipse's widest x-range over the band's pixel centres, clipped to where the ellipse is
        const float lo = std::max(band * kBlock + 0.5f - my, -reach_y);
        const float hi = std::min(band * kBlock + kBlock - 0.5f - my, reach_y);
        if (lo > hi) continue;
        const auto half_width = [&](float dy) { return std::sqrt(std::max(0.0f, b * b * dy * dy - a * (c * dy * dy - q))); };
        const float yr = std::clamp(dy_right, lo, hi), yl = std::clamp(-dy_right, lo, hi);
        const float right = mx + (-b * yr + half_width(yr)) / a, left = mx + (-b * yl - half_width(yl)) / a;
        // a hundredth of a pixel covers the rounding of the bound: masks may be generous, never short
        const int x0 = std::max(0, int(std::floor((left - 0.51f) / kBlock)) );
        const int x1 = std::min(blocks_x - 1, int(std::floor((right - 0.49f) / kBlock)));
        for (int tx = x0 / 8; tx <= x1 / 8 && x0 <= x1; ++tx) {
          const int from = std::max(x0 - tx * 8, 0), to = std::min(x1 - tx * 8, 7);
          const uint64_t row = ((0xFFull >> (7 - to)) & (0xFFull << from)) & 0xFFull;
          tile_x0 = std::min(tile_x0, tx);
          tile_x1 = std::max(tile_x1, tx);
          row_masks[tx] |= row << (8 * (band - tile_y * 8));
        }
      }
      for (int tx = tile_x0; tx <= tile_x1; ++tx) {
        if (!row_masks[tx]) continue;
        found.push_back({uint32_t(tile_y * bins.tiles_x + tx), {i, records[i]++, row_masks[tx]}});
      }
    }
  }

  bins.splat_begin.assign(s.count + 1, 0);
  for (int i = 0; i < s.count; ++i) bins.splat_begin[i + 1] = bins.splat_begin[i] + records[i];
  const int tiles = bins.tiles_x * bins.tiles_y;
  bins.tile_begin.assign(tiles + 1, 0);
  for (const TilePair& f : found) ++bins.tile_begin[f.tile + 1];
  for (int t = 0; t < tiles; ++t) bins.tile_begin[t + 1] += bins.tile_begin[t];
  std::vector<uint32_t> next(bins.tile_begin.begin(), bins.tile_begin.end() - 1);
  bins.pairs.resize(found.size());
  for (const TilePair& f : found) {
    Pair pair = f.pair;
    pair.record += bins.splat_begin[pair.splat];
    bins.pairs[next[f.tile]++] = pair;
  }
  return bins;
}

void for_each_tile(int tiles, int threads, const std::function<void(int)>& work) {
  std::atomic<int> next{0};
  const auto drain = [&] {
    for (int tile; (tile = next.fetch_add(1)) < tiles;) work(tile);
  };
  std::vector<std::thread> helpers;
  for (int t = 1; t < std::min(threads, tiles); ++t) helpers.emplace_back(drain);
  drain();
  for (std::thread& helper : helpers) helper.join();
}

}  // namespace obbgs

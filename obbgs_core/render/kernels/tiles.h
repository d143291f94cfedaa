// Blocks of pixels, one vector each, and tiles of 8x8 blocks, one 64-bit mask each.
// Included once for each instruction set, whose vectors decide how high a block is.
#pragma once
#include "machine/simd.h"
#include "rasterizer.h"

namespace obbgs {
namespace KERNEL {
namespace {

constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;          // px
constexpr int kTileWidth = 8 * kBlockWidth, kTileHeight = 8 * kBlockHeight;  // px

inline int tiles_x(const Scene& s) { return (s.width + kTileWidth - 1) / kTileWidth; }
inline int tiles_y(const Scene& s) { return (s.height + kTileHeight - 1) / kTileHeight; }
inline int tiles(const Scene& s) { return s.cameras * tiles_x(s) * tiles_y(s); }  // camera after camera

}  // namespace
}  // namespace KERNEL
}  // namespace obbgs

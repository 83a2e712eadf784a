#version 450
#extension GL_GOOGLE_include_directive : require
// Lists of each tile's Gaussians, nearest first: the Gaussians of the tile's set that may be visible in it, in the sorted
// order. All lists are empty if the entries exceed the capacity. One workgroup per tile column (x), row (y) and set (z).
#include "inc/blend.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { BlendSetup blend_setup; };
layout(binding = 1) readonly buffer B1 { BlendSet blend_sets[]; };
// Sorted by set and depth.
layout(binding = 2) readonly buffer B2 { BlendKey blend_keys[]; };
layout(binding = 3) readonly buffer B3 { BlendSpan blend_spans[]; };
// [set][tile row][tile column]
layout(binding = 4) readonly buffer B4 { uint blend_tile_counts[]; };
layout(binding = 5) buffer B5 { BlendCounts blend_counts; };
// [set][tile row][tile column]
layout(binding = 6) writeonly buffer B6 { BlendList blend_lists[]; };
layout(binding = 7) writeonly buffer B7 { uint blend_list_items[]; };

// Number of Gaussians that a lane tests before all lanes exchange their counts.
const uint GAUSSIANS_OF_LANE = 16u;

shared uint found_by[gl_WorkGroupSize.x];
shared uint first;

bool holds(BlendSpan span, uvec2 tile) {
    uvec2 begin = uvec2(span.first & 0xffffu, span.first >> 16), end = uvec2(span.end & 0xffffu, span.end >> 16);
    return all(lessThanEqual(begin, tile)) && all(lessThan(tile, end));
}

// Tests which of the Gaussians in [begin, end) may be visible in the tile; one bit per Gaussian.
uint found_from(uint begin, uint end, uvec2 tile) {
    uint found = 0u;
    for (uint k = 0u; k < GAUSSIANS_OF_LANE && begin + k < end; k++) {
        BlendKey key = blend_keys[begin + k];
        if (key.depth != UNSEEN && holds(blend_spans[key.index], tile)) found |= 1u << k;
    }
    return found;
}

void main() {
    uint lane = gl_LocalInvocationID.x, set = gl_WorkGroupID.z;
    uvec2 tile = gl_WorkGroupID.xy;
    uint at = (set * blend_setup.tile_rows + tile.y) * blend_setup.tile_columns + tile.x;
    uint count = blend_counts.entries <= blend_setup.capacity ? blend_tile_counts[at] : 0u;
    if (lane == 0u) {
        // The position of a list in memory does not change the picture.
        first = atomicAdd(blend_counts.listed, count);
        blend_lists[at] = BlendList(first, count);
    }
    barrier();
    if (count == 0u) return;
    uint begin = blend_sets[set].first, end = begin + blend_sets[set].count, next = first;
    while (next < first + count && begin < end) {
        uint found = found_from(begin + lane * GAUSSIANS_OF_LANE, end, tile);
        found_by[lane] = bitCount(found);
        barrier();
        uint place = next;
        for (uint k = 0u; k < gl_WorkGroupSize.x; k++) {
            if (k < lane) place += found_by[k];
            next += found_by[k];
        }
        for (; found != 0u; found &= found - 1u) {
            blend_list_items[place] = blend_keys[begin + lane * GAUSSIANS_OF_LANE + uint(findLSB(found))].index;
            place += 1u;
        }
        begin += GAUSSIANS_OF_LANE * gl_WorkGroupSize.x;
        barrier();
    }
}

#version 450
#extension GL_GOOGLE_include_directive : require
// Draws the rays of an iteration of one field, all from the image that is next in the order of images. The first rays are the
// pixels of windows of the image's tiling, the others are single non-empty pixels outside these windows. No window or pixel is
// drawn twice in an iteration, unless there are too few. One invocation per ray.
#include "inc/layout.glsl"
#include "inc/sax_layout.glsl"
#include "inc/random.glsl"
#include "inc/pixel_ray.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint seed; uint first_turn; uint n_turns; } push;
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { uint sax_turns[]; };     // images of the fields, in the order of their use
layout(binding = 3) readonly buffer B3 { View sax_views[]; };     // view of each image
layout(binding = 4) readonly buffer B4 { SaxList sax_lists[]; };  // list of each image
layout(binding = 5) readonly buffer B5 { uint sax_listed[]; };    // pixels
layout(binding = 6) readonly buffer B6 { float sax_images[]; };   // [image][pixel]
layout(binding = 7) writeonly buffer B7 { Ray rays[]; };

uint columns() { return sax_setup.width / sax_setup.window; }

// Tile of the image that is the `k`-th window.
uint tile_of(uint k) {
    uint n_tiles = columns() * (sax_setup.height / sax_setup.window);
    return permute(k, n_tiles, push.seed, state.step, STREAM_WINDOW);
}

uint pixel_of_window(uint ray) {
    uint side = sax_setup.window, at = ray % (side * side), tile = tile_of(ray / (side * side));
    uint column = tile % columns() * side + at % side, row = tile / columns() * side + at / side;
    return row * sax_setup.width + column;
}

bool in_a_window(uint pixel) {
    uvec2 tile = uvec2(pixel % sax_setup.width, pixel / sax_setup.width) / sax_setup.window;
    for (uint k = 0u; k < sax_setup.n_windows; k++)
        if (tile_of(k) == tile.y * columns() + tile.x && tile.x < columns()) return true;
    return false;
}

// Each ray has its own part of the permuted pixels and takes the first of them outside all windows, or the last one if all are
// inside.
uint single_pixel(uint ray, uint n_single, SaxList list) {
    uint pixel = 0u;
    for (uint at = ray % list.n; at < list.n; at += n_single) {
        pixel = sax_listed[list.first + permute(at, list.n, push.seed, state.step, STREAM_RAY)];
        if (!in_a_window(pixel)) break;
    }
    return pixel;
}

void main() {
    uint r = gl_GlobalInvocationID.x;
    if (r >= sax_setup.n_rays) return;
    uint image = sax_turns[push.first_turn + state.step % push.n_turns];
    uint of_windows = sax_setup.n_windows * sax_setup.window * sax_setup.window;
    uint pixel = r < of_windows ? pixel_of_window(r)
                                : single_pixel(r - of_windows, sax_setup.n_rays - of_windows, sax_lists[image]);
    Line line = line_through(sax_views[image], pixel, sax_setup.width);
    Ray ray;
    ray.anchor = line.anchor;
    ray.phase = 0u;
    ray.direction = line.direction;
    ray.norm = length(line.direction);
    ray.target = sax_images[image * sax_setup.width * sax_setup.height + pixel];
    ray.temporal_low = 0.0;
    ray.id = image * sax_setup.width * sax_setup.height + pixel;
    ray.temporal_high = 0.0;
    ray.beyond = 0u;
    ray.beyond_share = 0.0;
    ray.change = 0.0;
    rays[r] = ray;
}

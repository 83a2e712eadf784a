#version 450
#extension GL_GOOGLE_include_directive : require
// Draws the rays of one iteration. One invocation per ray.
//   rays[n_rays]: the first n_motion_rays rays follow a permutation of the rays that meet the motion hull (two networks: of the
//     rays whose pixels change); the others follow a permutation of all training rays or of the second part of `listed_rays`.
//     Both draws are without replacement.
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/pixel_ray.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
// Frames whose line integrals are in `images`, `first_frame` to below `end_frame`; rays of other frames are left as they are.
layout(push_constant) uniform Push { uint first_frame; uint end_frame; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { View views[]; };
layout(binding = 3) readonly buffer B3 { Frame frames[]; };
layout(binding = 4) readonly buffer B4 { float images[]; };
layout(binding = 5) readonly buffer B5 { vec2 backgrounds[]; };
layout(binding = 6) readonly buffer B6 { uint listed_rays[]; };
layout(binding = 7) readonly buffer B7 { float pixel_changes[]; };
layout(binding = 8) writeonly buffer B8 { Ray rays[]; };

uint draw(uint slot, uint per_step, uint n, uint stream) {
    uint counter = state.step * per_step + slot;
    return permute(counter % n, n, setup.seed, counter / n, stream);
}

void main() {
    uint r = gl_GlobalInvocationID.x;
    if (r >= setup.n_rays) return;
    uint id;
    if (r < setup.n_motion_rays) {
        id = listed_rays[draw(r, setup.n_motion_rays, setup.n_motion_list, STREAM_MOTION_RAY)];
    } else {
        bool all = setup.n_shown_list == 0u;
        uint n = all ? setup.n_all_rays : setup.n_shown_list;
        id = draw(r - setup.n_motion_rays, setup.n_rays - setup.n_motion_rays, n, STREAM_RAY);
        if (!all) id = listed_rays[setup.n_motion_list + id];
    }
    uint index = id / setup.n_pixels;
    if (index < push.first_frame || index >= push.end_frame) return;
    Frame frame = frames[index];
    View view = views[frame.view];
    uint pixel = id % setup.n_pixels;
    Line line = line_through(view, pixel, setup.image_width);
    Ray ray;
    ray.anchor = line.anchor;
    ray.phase = frame.phase;
    ray.direction = line.direction;
    ray.norm = setup.along_axis != 0u ? 1.0 : length(line.direction);
    ray.target = images[frame.image_offset + pixel];
    vec2 background = backgrounds[frame.background_offset + pixel];
    ray.temporal_low = ray.target - background.y;
    ray.id = id;
    ray.temporal_high = ray.target - background.x;
    ray.beyond = frame.beyond;
    ray.beyond_share = frame.beyond_share;
    ray.change = setup.two_networks != 0u ? pixel_changes[frame.background_offset + pixel] : 0.0;
    rays[r] = ray;
}

#version 450
#extension GL_GOOGLE_include_directive : require
// Samples along rays: their points in the unit cube, which corresponds to the grid's box, and their path lengths. Points
// outside the box are moved to its faces. One invocation per sample.
#include "inc/layout.glsl"
#include "inc/sax_layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint seed; uint first_ray; uint n_rays; } push;
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
layout(binding = 3) writeonly buffer B3 { vec4 sax_points[]; };  // [ray][sample]

// Distance that points keep from the faces, in sides of the box.
const float INSIDE = 1.7e-6;

void main() {
    uint s = invocation(), n = sax_setup.n_samples;
    if (s >= push.n_rays * n) return;
    uint r = push.first_ray + s / n, k = s % n;
    Ray ray = rays[r];
    float near = sax_setup.near, far = sax_setup.far;
    float depth = depth_at(k, n, near, far, sax_setup.jitter, push.seed, state.step, r + 1u);
    float path = path_length(depth, k, n, near, far, sax_setup.jitter, push.seed, state.step, r + 1u, ray.norm);
    vec3 x = ray.anchor + depth * ray.direction;
    sax_points[s] = vec4(clamp(x / (2.0 * sax_setup.bound) + 0.5, INSIDE, 1.0 - INSIDE), path);
}

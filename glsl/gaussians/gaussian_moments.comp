#version 450
#extension GL_GOOGLE_include_directive : require
// Moments of an image from which the gradient of a Gaussian is computed. With h = dL/dD times the Gaussian's value at a pixel,
// they are the sums over its box of h and of h times du, dv, du^2, du dv and dv^2, each in the order of the pixels. One
// invocation per splat, or several that share one, as in gaussian_splat.
#include "inc/gaussian.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/splat_lanes.glsl"
layout(push_constant) uniform Push { uint n_splats; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { Splat splats[]; };
layout(binding = 2) readonly buffer B2 { int image_of_splat[]; };
layout(binding = 3) readonly buffer B3 { float splat_image_gradient[]; };
// [splat][2]: (h, h du, h dv, -), (h du^2, h du dv, h dv^2, -).
layout(binding = 4) writeonly buffer B4 { vec4 splat_moments[]; };

void main() {
    if (push.n_splats == 0u) return;
    uint i = min(splat_index(), push.n_splats - 1u);
    Splat s = splats[i];
    int image = image_of_splat[i];
    ivec4 box = pixels_of(s, gaussian_setup);
    if (image < 0) box = ivec4(0, 0, -1, -1);
    uint first = uint(max(image, 0)) * gaussian_setup.image_stride;
    vec3 half_log2 = -HALF_LOG2_E * s.conic;
    vec3 linear = vec3(0.0), square = vec3(0.0);
    uint n = n_pixels(box);
    for (Walk walk = walk_from(box); walk.k < n; walk_on(walk, box)) {
        vec2 d = vec2(walk.at) - s.mean;
        uint pixel = uint(walk.at.y) * gaussian_setup.width + uint(walk.at.x);
        float h = splat_image_gradient[first + pixel] * falloff(half_log2, d);
        vec2 hd = h * d;
        linear += vec3(h, hd);
        square += vec3(hd.x * d.x, hd.x * d.y, hd.y * d.y);
    }
    linear = splat_sum(linear);
    square = splat_sum(square);
    if (splat_lane() != 0u || splat_index() >= push.n_splats) return;
    splat_moments[2u * i] = vec4(s.amplitude * linear, 0.0);
    splat_moments[2u * i + 1u] = vec4(s.amplitude * square, 0.0);
}

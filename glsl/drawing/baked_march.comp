#version 450
#extension GL_GOOGLE_include_directive : require
// Line integrals or maxima of baked volumes along the rays of a pose, sampled by the hardware. One invocation per pixel.
//   image[pixel]: line integral, or maximum attenuation per world unit, of the selected fields.
#include "inc/layout.glsl"
#include "inc/pixel_ray.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push {
    uint n_pixels; uint image_width; uint with_static; uint with_dynamic; uint maximum;
} push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { View views[]; };
layout(binding = 2) uniform sampler3D static_volume;
layout(binding = 3) uniform sampler3D dynamic_volume;
layout(binding = 4) writeonly buffer B4 { float image[]; };

// Depths between which a ray is inside a box.
vec2 crossing(Line line, vec3 low, vec3 high) {
    vec3 a = (low - line.anchor) / line.direction;
    vec3 b = (high - line.anchor) / line.direction;
    vec3 near = min(a, b);
    vec3 far = max(a, b);
    return vec2(max(max(near.x, near.y), near.z), min(min(far.x, far.y), far.z));
}

// Integral and maximum of a volume over the box within a range of depths. The samples are the middles of steps of about one
// cell.
vec2 along(sampler3D volume, Line line, float norm, vec3 low, vec3 high, vec2 depths) {
    vec2 span = crossing(line, low, high);
    span = vec2(max(span.x, depths.x), min(span.y, depths.y));
    if (!(span.y > span.x)) return vec2(0.0);
    vec3 cells = vec3(textureSize(volume, 0));
    // The centres of the first and the last cells lie on the faces of the box.
    vec3 per_unit = (cells - 1.0) / (high - low);
    float crossed = length(line.direction * per_unit) * (span.y - span.x);
    uint n = uint(ceil(max(crossed, 1.0)));
    float step = (span.y - span.x) / float(n);
    vec3 start = ((line.anchor + (span.x + 0.5 * step) * line.direction - low) * per_unit + 0.5) / cells;
    vec3 advance = step * line.direction * per_unit / cells;
    float sum = 0.0;
    float largest = 0.0;
    for (uint i = 0u; i < n; i++) {
        float sigma = textureLod(volume, start + float(i) * advance, 0.0).x;
        sum += sigma;
        largest = max(largest, sigma);
    }
    return vec2(sum * step * norm, largest);
}

void main() {
    uint pixel = invocation();
    if (pixel >= push.n_pixels) return;
    Line line = line_through(views[0], pixel, push.image_width);
    float norm = setup.along_axis != 0u ? 1.0 : length(line.direction);
    vec2 of_static = vec2(0.0);
    vec2 of_dynamic = vec2(0.0);
    if (push.with_static != 0u) {
        of_static = setup.static_gain * along(static_volume, line, norm, setup.static_min, setup.static_max,
                                          vec2(setup.static_near, setup.static_far));
    }
    if (push.with_dynamic != 0u) {
        of_dynamic = setup.dynamic_gain * along(dynamic_volume, line, norm, setup.dynamic_min, setup.dynamic_max,
                                            vec2(setup.dynamic_near, setup.dynamic_far));
    }
    image[pixel] = push.maximum != 0u ? max(of_static.y, of_dynamic.y) : of_static.x + of_dynamic.x;
}

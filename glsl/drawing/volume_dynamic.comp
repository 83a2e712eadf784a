#version 450
#extension GL_GOOGLE_include_directive : require
// Writes the attenuation of live samples to the rows of a volume, whose cells are the samples. One invocation per sample.
//   volume[row][n_dynamic_samples] must be cleared before; row: index of the ray in the batch.
#include "inc/layout.glsl"
#include "inc/sample_rays.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { LiveSamples live; };
layout(binding = 2) readonly buffer B2 { vec4 sample_points[]; };
layout(binding = 3) readonly buffer B3 { uint sample_rays[]; };
layout(binding = 4) readonly buffer B4 { vec2 sample_sigma[]; };
layout(binding = 5) writeonly buffer B5 { float volume[]; };

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= live.count) return;
    uint n = setup.n_dynamic_samples;
    float cell = (sample_points[s].x - setup.dynamic_near) / (setup.dynamic_far - setup.dynamic_near) * float(n - 1u);
    uint row = ray_of(sample_rays[s]);
    volume[row * n + min(uint(round(cell)), n - 1u)] = sample_sigma[s].x;
}

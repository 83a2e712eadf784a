#version 450
#extension GL_GOOGLE_include_directive : require
// Positional encoding of the live samples, at which the dynamic field is evaluated. One invocation per padded sample.
//   sample_times[s]: acquisition time of the sample's ray;
//   features[q * capacity + s]: vec4 of the numbers 4q..4q+3 of the encoding, padded with zeros.
#include "inc/layout.glsl"
#include "inc/sample_rays.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Schedule schedule[]; };
layout(binding = 3) readonly buffer B3 { LiveSamples live; };
layout(binding = 4) readonly buffer B4 { vec4 sample_points[]; };
layout(binding = 5) readonly buffer B5 { uint sample_rays[]; };
layout(binding = 6) readonly buffer B6 { Ray rays[]; };
layout(binding = 7) writeonly buffer B7 { vec4 features[]; };
layout(binding = 8) writeonly buffer B8 { SampleTime sample_times[]; };

#include "inc/encoding.glsl"

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= live.padded) return;
    uint groups = (3u + 6u * setup.n_bands + 3u) / 4u;
    uint stride = setup.sample_capacity;
    if (s >= live.count) {
        sample_times[s] = SampleTime(0u, 0u, 0.0);
        for (uint q = 0u; q < groups; q++) features[q * stride + s] = vec4(0.0);
        return;
    }
    Ray ray = rays[ray_of(sample_rays[s])];
    sample_times[s] = SampleTime(ray.phase, ray.beyond, ray.beyond_share);
    float window = schedule[state.step].window;
    vec3 x = encoded_point(sample_points[s].xyz);
    // Two bands have 12 numbers, which fill three vec4: after each pair of bands, `carry` again holds three numbers to be
    // written.
    vec3 carry = x;
    for (uint k = 0u; k < setup.n_bands; k += 2u) {
        vec3 sin0, cos0;
        encoded_band(x, k, window, sin0, cos0);
        uint q = (3u + 6u * k) / 4u;
        features[q * stride + s] = vec4(carry, sin0.x);
        features[(q + 1u) * stride + s] = vec4(sin0.yz, cos0.xy);
        if (k + 1u == setup.n_bands) {
            features[(q + 2u) * stride + s] = vec4(cos0.z, 0.0, 0.0, 0.0);
            return;
        }
        vec3 sin1, cos1;
        encoded_band(x, k + 1u, window, sin1, cos1);
        features[(q + 2u) * stride + s] = vec4(cos0.z, sin1);
        carry = cos1;
    }
    features[(groups - 1u) * stride + s] = vec4(carry, 0.0);
}

#version 450
#extension GL_EXT_control_flow_attributes : require
// Benchmark of the device's f32 units: twelve independent chains of multiply-adds, which leave some of the sixteen vector
// registers of a CPU free.
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint steps; float a; float b; } push;
layout(binding = 0) writeonly buffer B0 { vec4 sink[]; };

void main() {
    vec4 x[3];
    [[unroll]] for (uint i = 0u; i < 3u; i++) x[i] = vec4(float(gl_GlobalInvocationID.x) * 1e-6 + float(i));
    [[dont_unroll]] for (uint s = 0u; s < push.steps; s++) {
        [[unroll]] for (uint u = 0u; u < 32u; u++) {
            [[unroll]] for (uint i = 0u; i < 3u; i++) x[i] = x[i] * push.a + push.b;
        }
    }
    sink[gl_GlobalInvocationID.x] = x[0] + x[1] + x[2];
}

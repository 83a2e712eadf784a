#version 450
// Benchmark of the device's memory bandwidth: reads and writes 16 bytes per invocation.
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint count; } push;
layout(binding = 0) readonly buffer B0 { vec4 from[]; };
layout(binding = 1) writeonly buffer B1 { vec4 to[]; };

void main() {
    uint i = gl_GlobalInvocationID.x + gl_WorkGroupID.y * gl_NumWorkGroups.x * gl_WorkGroupSize.x;
    if (i < push.count) to[i] = from[i];
}

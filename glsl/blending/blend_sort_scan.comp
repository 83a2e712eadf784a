#version 450
#extension GL_GOOGLE_include_directive : require
// Second pass of the sort by four bits: replaces each count by the sum of the counts before it, which is the position of the
// first key of its digit and block. One workgroup.
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_counts; } push;
// [digit][block]
layout(binding = 0) buffer B0 { uint blend_sort_counts[]; };

shared uint of_lanes[gl_WorkGroupSize.x];

void main() {
    uint lane = gl_LocalInvocationID.x, each = (push.n_counts + gl_WorkGroupSize.x - 1u) / gl_WorkGroupSize.x;
    uint first = min(lane * each, push.n_counts), end = min(first + each, push.n_counts);
    uint sum = 0u;
    for (uint i = first; i < end; i++) sum += blend_sort_counts[i];
    of_lanes[lane] = sum;
    barrier();
    uint before = 0u;
    for (uint k = 0u; k < lane; k++) before += of_lanes[k];
    for (uint i = first; i < end; i++) {
        uint count = blend_sort_counts[i];
        blend_sort_counts[i] = before;
        before += count;
    }
}

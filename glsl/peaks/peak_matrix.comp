#version 450
#extension GL_GOOGLE_include_directive : require
// Benchmark of the device's matrix units: independent chains of matrix products in registers, four per step. The operands are
// not constant, because the power limit depends on the number of bits that change.
#include "inc/matrices.glsl"
layout(push_constant) uniform Push { uint steps; } push;
layout(binding = 0) readonly buffer B0 { uvec4 operands16[]; };
layout(binding = 1) writeonly buffer B1 { float sink[]; };
#ifdef DECLARATIONS_ONLY
void main() {}
#else

void main() {
    LEFT left[2];
    RIGHT right[2];
    SUM sums[4];
    [[unroll]] for (uint i = 0u; i < 2u; i++) {
        coopMatLoad(left[i], operands16, i * m * k / 8u, k / 8u, ROWS);
        coopMatLoad(right[i], operands16, i * k * n / 8u, n / 8u, ROWS);
    }
    [[unroll]] for (uint i = 0u; i < 4u; i++) sums[i] = SUM(0.0);
    [[dont_unroll]] for (uint s = 0u; s < push.steps; s++) {
        [[unroll]] for (uint i = 0u; i < 4u; i++) sums[i] = coopMatMulAdd(left[i & 1u], right[i / 2u], sums[i]);
    }
    uint at = (gl_WorkGroupID.x * subgroups + gl_SubgroupID) * m * n;
    coopMatStore((sums[0] + sums[1]) + (sums[2] + sums[3]), sink, at, n, ROWS);
}
#endif

// Cooperative matrices: f16 operands, f32 sums, subgroup scope. The shapes are among those that the device reports. Arrays of
// f16 are declared as uvec4 with eight numbers per element, for wide copies; offsets and strides are in uvec4. This file must
// be included first, because it contains extensions. With DECLARATIONS_ONLY, shaders end after their buffers and constants: a compiler
// that does not know cooperative matrices still compiles the interface.
#pragma use_vulkan_memory_model
#extension GL_KHR_memory_scope_semantics : require
#ifndef DECLARATIONS_ONLY
#extension GL_KHR_cooperative_matrix : require
#endif
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_EXT_shader_explicit_arithmetic_types_float16 : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint m = 16u;           // shape of a product: m x k times k x n
layout(constant_id = 2) const uint n = 16u;
layout(constant_id = 3) const uint k = 16u;
layout(constant_id = 4) const uint tile = 64u;        // number of samples of a workgroup's tile
layout(constant_id = 5) const uint subgroups = 8u;    // number of subgroups of a workgroup
layout(constant_id = 6) const uint width = 128u;      // number of neurons of a hidden layer
#define SUM coopmat<float, gl_ScopeSubgroup, m, n, gl_MatrixUseAccumulator>
#define SUM16 coopmat<float16_t, gl_ScopeSubgroup, m, n, gl_MatrixUseAccumulator>
#define LEFT coopmat<float16_t, gl_ScopeSubgroup, m, k, gl_MatrixUseA>
#define RIGHT coopmat<float16_t, gl_ScopeSubgroup, k, n, gl_MatrixUseB>
#define ROWS gl_CooperativeMatrixLayoutRowMajor
#define COLUMNS gl_CooperativeMatrixLayoutColumnMajor
// A CPU driver needs minutes to compile these loops if they are unrolled; a GPU then keeps their operands in registers.
#ifdef UNROLL
#define STEPS [[unroll]]
#else
#define STEPS [[dont_unroll]]
#endif
// Maximum of f16. Activations are limited to it to avoid an overflow.
const float LARGEST = 65504.0;

// STORE_F16 converts sums to f16 in registers and stores them in the rows of an array of uvec4. On a device without matrices of
// f16 sums, which must not even be declared there, it converts them in shared memory.
#ifdef DECLARATIONS_ONLY
#elif defined(F32_SUMS)
#define GRADIENT SUM
shared float sum_tile[subgroups * m * n];

void share_sums(SUM sum) {
    subgroupBarrier();
    coopMatStore(sum, sum_tile, gl_SubgroupID * m * n, n, ROWS);
    subgroupBarrier();
}

// Eight neighbours in a row of the sums in shared memory; a row has n / 8 such groups.
uvec4 shared_sums(uint e) {
    uint at = gl_SubgroupID * m * n + 8u * e;
    uvec4 packed;
    [[unroll]] for (uint i = 0u; i < 4u; i++) {
        packed[i] = packHalf2x16(vec2(sum_tile[at + 2u * i], sum_tile[at + 2u * i + 1u]));
    }
    return packed;
}

#define STORE_F16(sum, rows, at, stride) { \
    share_sums(sum); \
    for (uint e = gl_SubgroupInvocationID; e < m * n / 8u; e += gl_SubgroupSize) { \
        rows[(at) + e / (n / 8u) * (stride) + e % (n / 8u)] = shared_sums(e); \
    } \
}
#else
#define GRADIENT SUM16
#define STORE_F16(sum, rows, at, stride) coopMatStore(SUM16(sum), rows, at, stride, ROWS)
#endif

uint pack2(vec2 pair) {
    return packHalf2x16(clamp(pair, vec2(-LARGEST), vec2(LARGEST)));
}

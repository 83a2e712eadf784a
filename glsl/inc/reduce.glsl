// Sums and maxima over a workgroup, which every lane gets, in a fixed order: runs repeat bit by bit on a device. With SUBGROUP,
// lanes of a subgroup exchange values, and subgroups, all of them full, through shared memory; else all goes through shared
// memory, with any size of subgroups.
#ifdef SUBGROUP
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require

#define REDUCE(TYPE, NAME, SCRATCH, COMBINE)                                                                       \
    shared TYPE SCRATCH[gl_WorkGroupSize.x];                                                                       \
    TYPE NAME(TYPE value) {                                                                                        \
        for (uint apart = gl_SubgroupSize / 2u; apart > 0u; apart /= 2u)                                           \
            value = COMBINE(value, subgroupShuffleXor(value, apart));                                              \
        if (gl_NumSubgroups == 1u) return value;                                                                   \
        if (gl_SubgroupInvocationID == 0u) SCRATCH[gl_SubgroupID] = value;                                         \
        barrier();                                                                                                 \
        TYPE total = SCRATCH[0];                                                                                   \
        for (uint other = 1u; other < gl_NumSubgroups; other++) total = COMBINE(total, SCRATCH[other]);            \
        barrier();                                                                                                 \
        return total;                                                                                              \
    }
#else
#define REDUCE(TYPE, NAME, SCRATCH, COMBINE)                                                                       \
    shared TYPE SCRATCH[gl_WorkGroupSize.x];                                                                       \
    TYPE NAME(TYPE value) {                                                                                        \
        uint lane = gl_LocalInvocationID.x;                                                                        \
        SCRATCH[lane] = value;                                                                                     \
        barrier();                                                                                                 \
        for (uint width = gl_WorkGroupSize.x / 2u; width > 0u; width /= 2u) {                                      \
            if (lane < width) SCRATCH[lane] = COMBINE(SCRATCH[lane], SCRATCH[lane + width]);                       \
            barrier();                                                                                             \
        }                                                                                                          \
        TYPE total = SCRATCH[0];                                                                                   \
        barrier();                                                                                                 \
        return total;                                                                                              \
    }
#endif

#define SUM_OF(A, B) ((A) + (B))
REDUCE(float, workgroup_sum, sum_scratch, SUM_OF)
REDUCE(vec4, workgroup_sum, sum4_scratch, SUM_OF)
REDUCE(float, workgroup_max, max_scratch, max)

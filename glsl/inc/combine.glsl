// REDUCE defines a function that combines the values of LANES neighbouring lanes, a power of two, and returns the result in all
// of them. The order is fixed, so that runs on a device are bit-identical. With SUBGROUP, the lanes of a subgroup exchange
// values directly and the subgroups, all of them full, use shared memory. Otherwise all lanes use shared memory, for any size
// of subgroups. PREFIX defines a function that returns the sum of the values of the preceding lanes among the LANES.
#ifdef SUBGROUP
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require

#define REDUCE(TYPE, NAME, SCRATCH, COMBINE, LANES)                                                                \
    shared TYPE SCRATCH[gl_WorkGroupSize.x];                                                                       \
    TYPE NAME(TYPE value) {                                                                                        \
        for (uint apart = min(gl_SubgroupSize, LANES) / 2u; apart > 0u; apart /= 2u)                               \
            value = COMBINE(value, subgroupShuffleXor(value, apart));                                              \
        if (LANES <= gl_SubgroupSize) return value;                                                                \
        if (gl_SubgroupInvocationID == 0u) SCRATCH[gl_SubgroupID] = value;                                         \
        barrier();                                                                                                 \
        uint subgroups = LANES / gl_SubgroupSize;                                                                  \
        uint first = gl_SubgroupID / subgroups * subgroups;                                                        \
        TYPE total = SCRATCH[first];                                                                               \
        for (uint other = 1u; other < subgroups; other++) total = COMBINE(total, SCRATCH[first + other]);          \
        barrier();                                                                                                 \
        return total;                                                                                              \
    }

#define PREFIX(NAME, SCRATCH, LANES)                                                                               \
    shared uint SCRATCH[gl_WorkGroupSize.x];                                                                       \
    uint NAME(uint value) {                                                                                        \
        uint exchanging = min(gl_SubgroupSize, LANES);                                                             \
        uint place = gl_SubgroupInvocationID % exchanging;                                                         \
        uint sum = value;                                                                                          \
        for (uint apart = 1u; apart < exchanging; apart *= 2u) {                                                   \
            uint before = subgroupShuffle(sum, gl_SubgroupInvocationID - min(apart, place));                       \
            if (apart <= place) sum += before;                                                                     \
        }                                                                                                          \
        if (LANES <= gl_SubgroupSize) return sum - value;                                                          \
        if (place == exchanging - 1u) SCRATCH[gl_SubgroupID] = sum;                                                \
        barrier();                                                                                                 \
        uint subgroups = LANES / gl_SubgroupSize;                                                                  \
        uint first = gl_SubgroupID / subgroups * subgroups;                                                        \
        for (uint other = first; other < gl_SubgroupID; other++) sum += SCRATCH[other];                            \
        barrier();                                                                                                 \
        return sum - value;                                                                                        \
    }
#else
#define REDUCE(TYPE, NAME, SCRATCH, COMBINE, LANES)                                                                \
    shared TYPE SCRATCH[gl_WorkGroupSize.x];                                                                       \
    TYPE NAME(TYPE value) {                                                                                        \
        uint lane = gl_LocalInvocationID.x;                                                                        \
        SCRATCH[lane] = value;                                                                                     \
        barrier();                                                                                                 \
        for (uint width = LANES / 2u; width > 0u; width /= 2u) {                                                   \
            if (lane % LANES < width) SCRATCH[lane] = COMBINE(SCRATCH[lane], SCRATCH[lane + width]);               \
            barrier();                                                                                             \
        }                                                                                                          \
        TYPE total = SCRATCH[lane / LANES * LANES];                                                                \
        barrier();                                                                                                 \
        return total;                                                                                              \
    }

#define PREFIX(NAME, SCRATCH, LANES)                                                                               \
    shared uint SCRATCH[gl_WorkGroupSize.x];                                                                       \
    uint NAME(uint value) {                                                                                        \
        uint lane = gl_LocalInvocationID.x;                                                                        \
        SCRATCH[lane] = value;                                                                                     \
        barrier();                                                                                                 \
        if (lane % LANES == 0u) {                                                                                  \
            uint sum = 0u;                                                                                         \
            for (uint other = lane; other < lane + LANES; other++) {                                               \
                uint here = SCRATCH[other];                                                                        \
                SCRATCH[other] = sum;                                                                              \
                sum += here;                                                                                       \
            }                                                                                                      \
        }                                                                                                          \
        barrier();                                                                                                 \
        return SCRATCH[lane];                                                                                      \
    }
#endif

#define SUM_OF(A, B) ((A) + (B))

// Index of this lane in the workgroup; lanes that exchange values are neighbours.
uint workgroup_lane() {
#ifdef SUBGROUP
    return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID;
#else
    return gl_LocalInvocationID.x;
#endif
}

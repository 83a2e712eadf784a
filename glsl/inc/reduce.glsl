// Sums over a workgroup in a fixed order (reproducible, any subgroup size).
shared float reduce_scratch[gl_WorkGroupSize.x];

float workgroup_sum(float value) {
    uint lane = gl_LocalInvocationID.x;
    reduce_scratch[lane] = value;
    barrier();
    for (uint width = gl_WorkGroupSize.x / 2u; width > 0u; width /= 2u) {
        if (lane < width) reduce_scratch[lane] += reduce_scratch[lane + width];
        barrier();
    }
    float total = reduce_scratch[0];
    barrier();
    return total;
}

float workgroup_max(float value) {
    uint lane = gl_LocalInvocationID.x;
    reduce_scratch[lane] = value;
    barrier();
    for (uint width = gl_WorkGroupSize.x / 2u; width > 0u; width /= 2u) {
        if (lane < width) reduce_scratch[lane] = max(reduce_scratch[lane], reduce_scratch[lane + width]);
        barrier();
    }
    float largest = reduce_scratch[0];
    barrier();
    return largest;
}

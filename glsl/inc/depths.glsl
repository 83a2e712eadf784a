// Stratified depths. Each depth is jittered within its own interval between the mid-points of a regular grid that includes both
// ends. Without jitter, the depths are those of the grid.

float grid_depth(uint k, uint n, float near, float far) {
    return near + (far - near) * (float(k) / float(n - 1u));
}

float depth_at(uint k, uint n, float near, float far, uint jitter, uint seed, uint step, uint ray) {
    float centre = grid_depth(k, n, near, far);
    if (jitter == 0u) return centre;
    float lower = k == 0u ? centre : 0.5 * (grid_depth(k - 1u, n, near, far) + centre);
    float upper = k == n - 1u ? centre : 0.5 * (centre + grid_depth(k + 1u, n, near, far));
    return lower + (upper - lower) * uniform01(seed, STREAM_DEPTH + (ray << 4u), step, k);
}

// Path length of the sample at depth `here` with index k; almost zero for the last sample.
float path_length(float here, uint k, uint n, float near, float far, uint jitter, uint seed, uint step, uint ray,
                  float norm) {
    if (k == n - 1u) return 1e-10 * norm;
    return (depth_at(k + 1u, n, near, far, jitter, seed, step, ray) - here) * norm;
}

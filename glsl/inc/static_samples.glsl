// Samples of the static field along a ray. The including file must declare `setup` and `state` and include inc/depths.glsl.

struct StaticSample {
    vec3 x;
    float path_length;
};

StaticSample static_sample(uint k, Ray ray) {
    uint stream = setup.per_ray_depths != 0u ? ray.id + 1u : 0u;
    float depth = depth_at(k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter, setup.seed,
                           state.step, stream);
    float dl = path_length(depth, k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter, setup.seed,
                           state.step, stream, ray.norm);
    return StaticSample(ray.anchor + depth * ray.direction, dl);
}

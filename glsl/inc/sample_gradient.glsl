// Gradient dL/d feature of a sample of a network. The including file must declare the buffers of samples and rays first. Where
// the softplus is flat, the gradient would vanish even if a ray needs more attenuation. For such a ray, `min_slope` is
// therefore the lower limit of the slope. A ray that needs less attenuation has the softplus's own slope. For two networks,
// `sigma_gradient` has dL/d sigma of each sample.
float feature_gradient(uint s) {
    float slope = sample_sigma[s].y;
    if (setup.two_networks != 0u) return sigma_gradient[s] * slope;
    uint ray = sample_rays[s];
    float per_integral = ray_gradient[ray_of(ray)].y + (is_near(ray) ? setup.occlusion_weight : 0.0);
    if (per_integral < 0.0) slope = max(slope, setup.min_slope);
    return per_integral * sample_points[s].w * slope;
}

// Share of a cardiac phase in a ray: non-zero only for the two phases around the ray's acquisition time.
float phase_share(Ray ray, uint phase) {
    return (phase == ray.phase ? 1.0 - ray.beyond_share : 0.0) + (phase == ray.beyond ? ray.beyond_share : 0.0);
}

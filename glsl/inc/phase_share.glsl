// What a ray shows of a cardiac phase: nothing of most, and of those around the time when it was taken as it is near them.
float phase_share(Ray ray, uint phase) {
    return (phase == ray.phase ? 1.0 - ray.beyond_share : 0.0) + (phase == ray.beyond ? ray.beyond_share : 0.0);
}

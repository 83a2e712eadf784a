// A word of sample_rays: the ray of the batch, and in the top bit whether the sample is near, that is, subject to
// occlusion minimisation.
const uint NEAR_SAMPLE = 0x80000000u;    // the top bit

uint sample_ray(uint ray, bool near) {
    return near ? ray | NEAR_SAMPLE : ray;
}

uint ray_of(uint word) {
    return word & ~NEAR_SAMPLE;
}

bool is_near(uint word) {
    return (word & NEAR_SAMPLE) != 0u;
}

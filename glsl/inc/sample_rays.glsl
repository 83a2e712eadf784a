// A word of sample_rays has the index of the ray in the batch and, in the top bit, whether the sample is near, that is, subject
// to occlusion minimisation.
const uint NEAR_SAMPLE = 0x80000000u;    // top bit of a near sample

uint sample_ray(uint ray, bool near) {
    return near ? ray | NEAR_SAMPLE : ray;
}

uint ray_of(uint word) {
    return word & ~NEAR_SAMPLE;
}

bool is_near(uint word) {
    return (word & NEAR_SAMPLE) != 0u;
}

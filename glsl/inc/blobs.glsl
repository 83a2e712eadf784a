// Selection of the Gaussians that a workgroup's points or rays can meet, 64 at a time. The including file must declare `blobs`.

// One bit for each of 64 Gaussians. The bits are read in order, so that sums are bit-identical between runs.
shared uint near_blobs[2];

vec3 blob_times(Blob b, vec3 v) {
    return vec3(b.diagonal.x * v.x + b.mixed.x * v.y + b.mixed.y * v.z,
                b.mixed.x * v.x + b.diagonal.y * v.y + b.mixed.z * v.z,
                b.mixed.y * v.x + b.mixed.z * v.y + b.diagonal.z * v.z);
}

// Upper bound of the factor by which a length increases when it is divided by the Gaussian's standard deviations.
float stretch_of(Blob b) {
    vec3 mixed = abs(b.mixed);
    vec3 sums = b.diagonal + vec3(mixed.x + mixed.y, mixed.x + mixed.z, mixed.y + mixed.z);
    return sqrt(max(sums.x, max(sums.y, sums.z)));
}

// Records whether the Gaussian of this lane is near; afterwards `near_blobs` is valid in all lanes.
void mark_near(bool near) {
    uint lane = gl_LocalInvocationID.x;
    barrier();
    if (lane < 2u) near_blobs[lane] = 0u;
    barrier();
    if (near) atomicOr(near_blobs[lane >> 5], 1u << (lane & 31u));
    barrier();
}

#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of the filling of each Gaussian at each phase, and Adam's update, except at the rest phase, where vessels are full by
// definition. With m the first moment of a splat, whose amplitude contains the filling F of the time of its image, an image that
// shows a phase with the share w contributes
//   dL/df = w m / F
// Fillings stay between `min_filling`, which is above zero, and 1, so that F is never zero. One invocation per Gaussian.
#include "inc/gaussian_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; uint rest_phase; float rate; float min_filling; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { GaussianView gaussian_views[]; };
// [phase][view][Gaussian]: index of the image, or -1.
layout(binding = 2) readonly buffer B2 { int image_of_splat[]; };
// [phase][view][Gaussian][2]
layout(binding = 3) readonly buffer B3 { vec4 splat_moments[]; };
layout(binding = 4) readonly buffer B4 { GaussianSchedule gaussian_schedule[]; };
layout(binding = 5) readonly buffer B5 { uint gaussian_step; };
// [Gaussian][phase]; moments of Adam and gradients likewise.
layout(binding = 6) buffer B6 { float filling[]; };
layout(binding = 7) buffer B7 { float filling_first[]; };
layout(binding = 8) buffer B8 { float filling_second[]; };
layout(binding = 9) buffer B9 { float filling_gradient[]; };
#include "inc/filling.glsl"
#include "inc/gaussian_adam.glsl"

void add_gradients(uint i, uint phase) {
    uint first = i * gaussian_setup.n_phases;
    for (uint view = 0u; view < gaussian_setup.n_views; view++) {
        uint at = (phase * gaussian_setup.n_views + view) * push.n_gaussians + i;
        int image = image_of_splat[at];
        if (image < 0) continue;
        float after_phase = gaussian_views[image].du.w;
        float g = splat_moments[2u * at].x / filling_at(i, phase, after_phase);
        filling_gradient[first + phase] += (1.0 - abs(after_phase)) * g;
        if (after_phase != 0.0) filling_gradient[first + phase_beyond(phase, after_phase)] += abs(after_phase) * g;
    }
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_gaussians) return;
    uint first = i * gaussian_setup.n_phases, end = first + gaussian_setup.n_phases;
    for (uint at = first; at < end; at++) filling_gradient[at] = 0.0;
    for (uint phase = 0u; phase < gaussian_setup.n_phases; phase++) add_gradients(i, phase);
    GaussianSchedule now = gaussian_schedule[gaussian_step];
    for (uint at = first; at < end; at++) {
        if (at == first + push.rest_phase) continue;
        vec4 mean = vec4(filling_first[at]), square = vec4(filling_second[at]);
        float change = adam(vec4(filling_gradient[at]), vec4(push.rate), now, mean, square).x;
        filling[at] = clamp(filling[at] - change, push.min_filling, 1.0);
        filling_first[at] = mean.x;
        filling_second[at] = square.x;
    }
}

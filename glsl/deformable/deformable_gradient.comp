#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of each Gaussian of the deformable set from its moments in the views of some phases, summed in their order: of its
// shape and its position at rest, and of its position at each phase. An image between two phases contributes to both. One
// invocation per Gaussian.
#include "inc/gaussian.glsl"
#include "inc/gaussian_gradient.glsl"
#include "inc/deformable_grid.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; uint first_phase; uint n_phases; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { MotionGridSetup deformable_setup; };
layout(binding = 2) readonly buffer B2 { GaussianView gaussian_views[]; };
layout(binding = 3) readonly buffer B3 { Gaussian gaussians[]; };
layout(binding = 4) readonly buffer B4 { vec4 motion_grid[]; };
layout(binding = 5) readonly buffer B5 { vec4 own_motion[]; };
layout(binding = 6) readonly buffer B6 { float motion_basis[]; };
layout(binding = 7) readonly buffer B7 { int image_of_splat[]; };
layout(binding = 8) readonly buffer B8 { vec4 splat_moments[]; };
// [Gaussian]: position and log-density, log-scale, rotation.
layout(binding = 9) writeonly buffer B9 { vec4 gaussian_gradient[]; };
// [phase][Gaussian]: gradient of the position.
layout(binding = 10) buffer B10 { vec4 place_gradient[]; };
#include "inc/gaussian_motion.glsl"
// Value that differs from every time after a phase.
const float NEVER = 2.0;

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_gaussians) return;
    Gaussian g = gaussians[i];
    GaussianGradient sum = no_gradient();
    vec3 at_rest = vec3(0.0);
    for (uint t = 0u; t < push.n_phases; t++)
        place_gradient[(push.first_phase + t) * push.n_gaussians + i] = vec4(0.0);
    for (uint t = 0u; t < push.n_phases; t++) {
        uint phase = push.first_phase + t;
        sum.position = vec3(0.0);
        // The images of a phase usually have the same acquisition time; the position is recomputed only if the time changes.
        vec3 x;
        float x_after_phase = NEVER;
        for (uint view = 0u; view < gaussian_setup.n_views; view++) {
            uint at = (t * gaussian_setup.n_views + view) * push.n_gaussians + i;
            int image = image_of_splat[at];
            if (image < 0) continue;
            float after_phase = gaussian_views[image].du.w;
            if (after_phase != x_after_phase) x = position_at(i, g.position, phase, after_phase);
            x_after_phase = after_phase;
            Projection p = project(g, x, gaussian_views[image], gaussian_setup);
            if (!(p.depth > 0.0)) continue;
            vec3 linear = splat_moments[2u * at].xyz, square = splat_moments[2u * at + 1u].xyz;
            vec3 others = sum.position;
            sum.position = vec3(0.0);
            add_gradient(g, p, gaussian_views[image], gaussian_setup, linear, square, sum);
            if (after_phase != 0.0) {
                vec3 beyond = abs(after_phase) * sum.position;
                place_gradient[phase_beyond(phase, after_phase) * push.n_gaussians + i].xyz += beyond;
                at_rest += beyond;
                sum.position -= beyond;
            }
            sum.position += others;
        }
        place_gradient[phase * push.n_gaussians + i].xyz += sum.position;
        at_rest += sum.position;
    }
    gaussian_gradient[3u * i] = vec4(at_rest, sum.log_density);
    gaussian_gradient[3u * i + 1u] = vec4(sum.log_scale, 0.0);
    gaussian_gradient[3u * i + 2u] = sum.rotation;
}

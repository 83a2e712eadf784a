#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of each Gaussian of R2-Gaussian with respect to its stored numbers, from its moments in the view and in the box of
// voxels; the statistic of density control, which is the norm of the image gradient at its centre; and Adam's update. One
// invocation per Gaussian.
#include "inc/r2.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { R2Setup r2_setup; };
layout(binding = 2) readonly buffer B2 { GaussianView gaussian_views[]; };
layout(binding = 3) readonly buffer B3 { PictureTurn picture_turns[]; };
layout(binding = 4) readonly buffer B4 { R2Schedule r2_schedule[]; };
layout(binding = 5) readonly buffer B5 { uint gaussian_step; };
// [Gaussian][2] of gaussian_moments, or [Gaussian][3] of r2_chord_moments.
layout(binding = 6) readonly buffer B6 { vec4 splat_moments[]; };
layout(binding = 7) readonly buffer B7 { vec4 r2_voxel_moments[]; };
layout(binding = 8) buffer B8 { R2Gaussian r2_gaussians[]; };
// First and second moments of Adam, in the layout of the Gaussians: position and density, scale, rotation.
layout(binding = 9) buffer B9 { vec4 gaussian_adam_first[]; };
layout(binding = 10) buffer B10 { vec4 gaussian_adam_second[]; };
// Gradient in this layout.
layout(binding = 11) writeonly buffer B11 { vec4 gaussian_gradient[]; };
// [Gaussian]: sum over iterations of the norm of the gradient with respect to the centre, in half images, and number of
// iterations in which the Gaussian was seen.
layout(binding = 12) buffer B12 { vec2 r2_statistics[]; };
layout(binding = 13) readonly buffer B13 { Splat splats[]; };

// Adds the gradient from contributions at points or along rays, given as sums of h times (c, 1), of h times the squares and of
// h times the mixed products of coordinates along the Gaussian's axes.
void add_along_axes(vec4 linear, vec3 square, vec3 mixed, R2Gaussian g, R2Projection p, inout GaussianGradient sum) {
    sum.position += p.at.axes * (linear.xyz / p.at.scale);
    sum.log_density += linear.w;
    sum.log_scale += square;
    mat3 second = mat3(square.x, mixed.x, mixed.y, mixed.x, square.y, mixed.z, mixed.y, mixed.z, square.z);
    mat3 d_axes;
    for (int k = 0; k < 3; k++) d_axes[k] = -(p.at.axes * (p.at.scale * second[k])) / p.at.scale[k];
    sum.rotation += rotation_gradient(g.rotation, d_axes);
}

// Adds the gradient of the total variation.
void add_voxels(uint i, R2Gaussian g, R2Projection p, inout GaussianGradient sum) {
    vec4 linear = r2_voxel_moments[3u * i];
    if (r2_setup.tv_moves_centres == 0u) linear.xyz = vec3(0.0);
    add_along_axes(linear, r2_voxel_moments[3u * i + 1u].xyz, r2_voxel_moments[3u * i + 2u].xyz, g, p, sum);
}

// Adds the gradient of the picture. Returns the gradient with respect to the centre's column and row.
vec2 add_picture(uint i, R2Gaussian g, R2Projection p, GaussianView view, inout GaussianGradient sum) {
    if (r2_setup.exact != 0u) {
        vec4 linear = splat_moments[3u * i];
        add_along_axes(linear, splat_moments[3u * i + 1u].xyz, splat_moments[3u * i + 2u].xyz, g, p, sum);
        vec3 by_centre = p.at.axes * (linear.xyz / p.at.scale);
        return p.at.depth * vec2(dot(view.du.xyz, by_centre), dot(view.dv.xyz, by_centre));
    }
    vec3 linear = splat_moments[2u * i].xyz;
    sum = gradient_r2(g, p, view, linear, splat_moments[2u * i + 1u].xyz);
    vec3 conic = p.splat.conic;
    return vec2(dot(conic.xy, linear.yz), dot(conic.yz, linear.yz));
}

vec4 step_of(uint at, vec4 g, vec4 rate, R2Schedule now) {
    gaussian_gradient[at] = g;
    if (now.updates == 0u) return vec4(0.0);
    float beta1 = gaussian_setup.beta1, beta2 = gaussian_setup.beta2;
    vec4 first = beta1 * gaussian_adam_first[at] + (1.0 - beta1) * g;
    vec4 second = beta2 * gaussian_adam_second[at] + (1.0 - beta2) * g * g;
    gaussian_adam_first[at] = first;
    gaussian_adam_second[at] = second;
    return rate * (first / now.bias1) / (sqrt(second / now.bias2) + gaussian_setup.epsilon);
}

void main() {
    uint i = invocation();
    if (i >= push.n_gaussians) return;
    R2Schedule now = r2_schedule[gaussian_step];
    R2Gaussian g = r2_gaussians[i];
    GaussianView view = gaussian_views[picture_turns[gaussian_step * r2_setup.n_sets + g.set].image];
    R2Projection p = project_r2(g, view, gaussian_setup);
    GaussianGradient sum = no_gradient();
    if (n_pixels(pixels_of(splats[i], gaussian_setup)) > 0u) {
        vec2 half_image = 0.5 * vec2(float(gaussian_setup.width), float(gaussian_setup.height));
        vec2 pull = half_image * add_picture(i, g, p, view, sum);
        r2_statistics[i] += vec2(length(pull), 1.0);
    }
    if (r2_setup.tv_weight > 0.0) add_voxels(i, g, p, sum);
    vec4 place = vec4(sum.position, sum.log_density * density_slope(g));
    vec4 place_rate = vec4(vec3(now.position_rate), now.density_rate);
    vec4 moved = step_of(3u * i, place, place_rate, now);
    vec4 scale = vec4(sum.log_scale * scale_slope(g, gaussian_setup), 0.0);
    vec4 grown = step_of(3u * i + 1u, scale, vec4(now.scale_rate), now);
    vec4 turned = step_of(3u * i + 2u, sum.rotation, vec4(now.rotation_rate), now);
    r2_gaussians[i].position = g.position - moved.xyz;
    r2_gaussians[i].density = g.density - moved.w;
    r2_gaussians[i].scale = g.scale - grown.xyz;
    r2_gaussians[i].rotation = g.rotation - turned;
}

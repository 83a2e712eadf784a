#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Line integrals, loss and gradient of the rays of a batch:
//   ray_out[ray] = integrals of sigma_l and sigma_s, occlusion term;
//   ray_gradient[ray], ray_loss[ray]: derivatives of the ray's loss with respect to the integrals, and the loss
//     (inc/ray_loss.glsl);
//   static_gradient[2 * parameter] = low and high word of the gradient of the static field's planes and lines.
// The kernel also records which cells of the occupancy were empty or occupied (inc/occupancy.glsl).
//
// The gradient of planes and lines is summed in 64-bit fixed point by integer atomics, on two words of 32 bits or on one of 64
// bits. These sums are exact and hence independent of the order. Every sample of every ray adds to the few texels of the lines.
// With `private_lines`, a workgroup therefore sums the lines in shared memory first and adds them to memory once.
#include "inc/fixed_point.glsl"
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
#include "inc/softplus.glsl"
#include "inc/sample_rays.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(constant_id = 1) const uint private_lines = 0u;  // numbers of all lines; 0: direct sums in memory
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) SETUP B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
layout(binding = 3) readonly buffer B3 { uint ray_start[]; };
layout(binding = 4) readonly buffer B4 { vec4 sample_points[]; };
layout(binding = 5) readonly buffer B5 { uint sample_rays[]; };
layout(binding = 6) readonly buffer B6 { vec2 sample_sigma[]; };
READ_VEC4(7, B7, static_params);
layout(binding = 8) writeonly buffer B8 { RayOut ray_out[]; };
layout(binding = 9) writeonly buffer B9 { vec2 ray_gradient[]; };
layout(binding = 10) writeonly buffer B10 { vec4 ray_loss[]; };
FIXED_SUMS(11, B11, static_gradient);
layout(binding = 12) buffer B12 { uint occupancy[]; };
#include "inc/tensor_vm.glsl"
#include "inc/march_rays.glsl"
#include "inc/static_rays.glsl"
#include "inc/static_samples.glsl"
#include "inc/ray_loss.glsl"
#include "inc/occupancy.glsl"

REDUCE(vec4, ray_sum, sum_scratch, SUM_OF, ray_lanes)

shared uint line_sums[2u * private_lines + 1u];
shared uint rays_that_scatter[rays_of_workgroup];

void note_cell(uint entry, uint bits) {
    uint epoch = state.step / OCCUPANCY_EPOCH;
    uint word = (epoch % OCCUPANCY_EPOCHS) * occupancy_words() + entry / CELLS_PER_WORD;
    atomicOr(occupancy[word], bits << (2u * (entry % CELLS_PER_WORD)));
}

// Records in the occupancy, for the cell of a live sample and the phases that the sample shows, that the cell was evaluated and
// whether it was occupied. For a phase with a small share of the sample, only an occupied cell is recorded.
void note_sample(vec3 x, Ray ray, float sigma) {
    bool full = sigma > setup.occupancy_threshold;
    uint bits = SEEN | (full ? OCCUPIED : 0u);
    note_cell(occupancy_entry(x, ray.phase), bits);
    if (ray.beyond_share >= LITTLE_SHOWN || full && ray.beyond_share > 0.0) note_cell(occupancy_entry(x, ray.beyond), bits);
}

RayOut integrals(uint r, Ray ray) {
    uint lane = ray_lane();
    float static_sum = 0.0;
    uint n_static = skips_static(r) ? 0u : setup.n_static_samples;
    for (uint k = lane; k < n_static; k += ray_lanes) {
        StaticSample here = static_sample(k, ray);
        if (static_inside(here.x)) static_sum += static_attenuation(here.x) * here.path_length;
    }
    float dynamic_sum = 0.0;
    float occlusion = 0.0;
    uint end = ray_start[ray_of_chunk() + 1u];
    for (uint s = ray_start[ray_of_chunk()] + lane; s < end; s += ray_lanes) {
        vec4 point = sample_points[s];
        float sigma = sample_sigma[s].x;
        dynamic_sum += sigma * point.w;
        if (is_near(sample_rays[s])) occlusion += sigma * point.w;
        if (setup.occupancy_cells != 0u) note_sample(point.xyz, ray, sigma);
    }
    vec4 sums = ray_sum(vec4(static_sum, dynamic_sum, occlusion, 0.0));
    return RayOut(sums.x, sums.y, sums.z, 0.0, 0.0, 0.0);
}

void add_to_memory(uint parameter, uvec2 fixed_point) {
    ADD_FIXED_TO_MEMORY(static_gradient, parameter, fixed_point);
}

void add_to_plane(uint texel, vec4 value, float scale_high) {
    [[unroll]] for (uint c = 0u; c < 4u; c++) {
        if (value[c] != 0.0) add_to_memory(4u * texel + c, to_fixed(value[c], scale_high));
    }
}

void add_to_line(uint texel, vec4 value, float scale_high) {
    uint first = setup.static_params - private_lines;
    [[unroll]] for (uint c = 0u; c < 4u; c++) {
        if (value[c] == 0.0) continue;
        uvec2 fixed_point = to_fixed(value[c], scale_high);
        if (private_lines == 0u) {
            add_to_memory(4u * texel + c, fixed_point);
        } else {
            ADD_FIXED(line_sums, 4u * texel + c - first, fixed_point);
        }
    }
}

// Whether any ray of the workgroup has a gradient to scatter. The result is equal in all lanes.
bool any_scatters(bool scatters) {
    if (rays_of_workgroup == 1u) return scatters;
    if (ray_lane() == 0u) rays_that_scatter[ray_of_workgroup()] = uint(scatters);
    barrier();
    uint any = 0u;
    for (uint i = 0u; i < rays_of_workgroup; i++) any |= rays_that_scatter[i];
    return any != 0u;
}

// Scatters the gradient with respect to the ray's static integral. All lanes of the workgroup must call it, also those without
// a gradient.
void scatter(Ray ray, float gradient) {
    uint lane = gl_LocalInvocationID.x;
    for (uint i = lane; i < 2u * private_lines; i += gl_WorkGroupSize.x) line_sums[i] = 0u;
    barrier();
    float scale_high = exp2(float(setup.fixed_point_bits) - 32.0);
    uint n_static = gradient == 0.0 ? 0u : setup.n_static_samples;
    for (uint k = ray_lane(); k < n_static; k += ray_lanes) {
        StaticSample here = static_sample(k, ray);
        if (!static_inside(here.x)) continue;
        float slope = setup.static_gain * sigmoid(vm_feature(here.x) + setup.static_shift);
        float at_feature = gradient * here.path_length * slope;
        vec3 coordinate = vm_coordinate(here.x);
        for (uint mode = 0u; mode < 3u; mode++) {
            VmTaps taps = vm_taps(coordinate, mode);
            for (uint c = 0u; c < setup.rank4; c++) {
                vec4 to_plane = at_feature * vm_line(taps, c);
                vec4 to_line = at_feature * vm_plane(taps, c);
                [[unroll]] for (uint t = 0u; t < 4u; t++) {
                    add_to_plane(taps.plane[t] * setup.rank4 + c, taps.plane_weight[t] * to_plane, scale_high);
                }
                [[unroll]] for (uint t = 0u; t < 2u; t++) {
                    add_to_line(taps.line[t] * setup.rank4 + c, taps.line_weight[t] * to_line, scale_high);
                }
            }
        }
    }
    barrier();
    for (uint i = lane; i < private_lines; i += gl_WorkGroupSize.x) {
        uvec2 sum = uvec2(line_sums[2u * i], line_sums[2u * i + 1u]);
        if (sum != uvec2(0u)) add_to_memory(setup.static_params - private_lines + i, sum);
    }
}

void main() {
    uint r = push.first_ray + ray_of_chunk();
    Ray ray = rays[r];
    RayOut seen = integrals(r, ray);
    RayLoss loss = loss_of(r, ray, seen);
    if (ray_lane() == 0u && has_ray()) {
        ray_out[r] = seen;
        ray_gradient[r] = loss.gradient;
        ray_loss[r] = loss.terms;
    }
    // The gradient is also zero for rays that skip the static field.
    float gradient = has_ray() ? loss.gradient.x : 0.0;
    if (any_scatters(gradient != 0.0)) scatter(ray, gradient);
}

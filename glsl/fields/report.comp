#version 450
#extension GL_GOOGLE_include_directive : require
// Completes an iteration: sums the losses into a ring buffer that the host reads from time to time, adapts the loss scale and
// increments the step. It also clears a slice of the next epoch's occupancy, so that the whole of it is clear after one epoch.
//   ring[step % ring_length]: results of the iteration; after training has stopped, the results of the last iteration.
#include "inc/layout.glsl"
layout(local_size_x = 256, local_size_x_id = 0) in;
layout(constant_id = 1) const uint loss_scaling = 0u;
layout(push_constant) uniform Push { uint n_tv_parts; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { vec4 ray_loss[]; };
layout(binding = 3) readonly buffer B3 { float tv_parts[]; };
layout(binding = 4) readonly buffer B4 { LiveSamples live; };
layout(binding = 5) buffer B5 { StepReport ring[]; };
layout(binding = 6) readonly buffer B6 { vec4 ray_regularisers[]; };
layout(binding = 7) readonly buffer B7 { Schedule schedule[]; };
layout(binding = 8) writeonly buffer B8 { uint occupancy[]; };
#include "inc/reduce.glsl"
#include "inc/occupancy.glsl"

const float OVERFLOW_FACTOR = 0.0625;
const uint UPDATES_TO_RETURN = 20u;
const uint UPDATES_TO_GROW = 500u;
const float LARGEST_SCALE = 16777216.0;

// Overflows reduce the scale immediately. It then returns quickly to half of the scale at which the first overflow occurred:
// gradients that were large for only a few iterations, for example when the dynamic field starts, would otherwise leave later
// gradients among the subnormal numbers of f16 for thousands of iterations.
void adapt_scale(float scale) {
    uint good = state.good_updates;
    if (state.overflowed != 0u) {
        bool in_a_row = good == 0u && state.return_scale > 0.0;
        if (!in_a_row) state.return_scale = 0.5 * scale;
        scale = max(OVERFLOW_FACTOR * scale, 1.0);
        good = 0u;
    } else {
        good += 1u;
        if (good > (scale < state.return_scale ? UPDATES_TO_RETURN : UPDATES_TO_GROW)) {
            scale = min(2.0 * scale, LARGEST_SCALE);
            good = 1u;
        }
    }
    state.loss_scale = scale;
    state.overflowed = 0u;
    state.good_updates = good;
}

// Adds the losses that only two networks have.
StepReport with_regularisers(StepReport result, vec4 regularisers) {
    Schedule now = schedule[state.step];
    float vanishing = min(regularisers.x, regularisers.y);
    bool over = setup.stop_after > 0u && result.step > setup.stop_after && vanishing < setup.stop_below;
    result.favour_static = now.favour_static * regularisers.x;
    result.ray_entropy = now.ray_entropy * regularisers.y;
    result.static_size = now.static_size * regularisers.z;
    result.stopped = over ? 1u : 0u;
    return result;
}

void clear_occupancy() {
    uint words = occupancy_words();
    uint slice = (words + OCCUPANCY_EPOCH - 1u) / OCCUPANCY_EPOCH;
    uint first = state.step % OCCUPANCY_EPOCH * slice;
    uint next = (state.step / OCCUPANCY_EPOCH + 1u) % OCCUPANCY_EPOCHS;
    for (uint word = first + gl_LocalInvocationID.x; word < min(first + slice, words); word += gl_WorkGroupSize.x)
        occupancy[next * words + word] = 0u;
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    if (setup.occupancy_cells != 0u) clear_occupancy();
    bool two_networks = setup.two_networks != 0u;
    vec4 losses = vec4(0.0);
    vec4 regularisers = vec4(0.0);
    for (uint r = lane; r < setup.n_rays; r += gl_WorkGroupSize.x) {
        losses += ray_loss[r];
        if (two_networks) regularisers += ray_regularisers[r];
    }
    float tv = 0.0;
    for (uint i = lane; i < push.n_tv_parts; i += gl_WorkGroupSize.x) tv += tv_parts[i];
    float data = workgroup_sum(losses.x);
    float dynamic_data = workgroup_sum(losses.y);
    float occlusion = workgroup_sum(losses.z);
    float squared = workgroup_sum(losses.w);
    tv = workgroup_sum(tv);
    if (two_networks) regularisers = workgroup_sum(regularisers);
    if (lane == 0u) {
        uint step = state.step;
        float occlusion_weight = two_networks ? schedule[step].near_integral : setup.occlusion_weight;
        StepReport result = StepReport(data, dynamic_data, tv, occlusion_weight * occlusion, squared, live.of_iteration,
                                       step + 1u, state.loss_scale, 0.0, 0.0, 0.0, 0u);
        if (two_networks) result = with_regularisers(result, regularisers);
        if (state.stopped != 0u) {
            result = ring[(step - 1u) % setup.ring_length];
            result.step = step + 1u;
        }
        result.stopped = max(result.stopped, state.stopped);
        ring[step % setup.ring_length] = result;
        state.stopped = result.stopped;
        if (loss_scaling != 0u && live.of_iteration > 0u) adapt_scale(state.loss_scale);
        state.step = step + 1u;
    }
}

#version 450
#extension GL_GOOGLE_include_directive : require
// Adam in f32. One invocation per parameter; the dynamic field rests while it is delayed, and all
// moments restart where the schedule re-creates the optimiser.
#include "inc/layout.glsl"
layout(local_size_x = 128, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Schedule schedule[]; };
layout(binding = 3) readonly buffer B3 { float gradient[]; };
layout(binding = 4) buffer B4 { vec2 moments[]; };
layout(binding = 5) buffer B5 { float params[]; };

void main() {
    uint i = invocation();
    if (i >= setup.n_params) return;
    Schedule now = schedule[state.step];
    bool is_static = i < setup.static_params;
    if (state.stopped != 0u) return;
    // A network's gradient overflowed, so this update is skipped.
    bool of_network = !is_static || setup.two_networks != 0u;
    if (of_network && (now.dynamic_active == 0u || state.overflowed != 0u)) return;
    float g = gradient[i];
    vec2 moment = now.reset != 0u ? vec2(0.0) : moments[i];
    moment.x = setup.beta1 * moment.x + (1.0 - setup.beta1) * g;
    moment.y = setup.beta2 * moment.y + (1.0 - setup.beta2) * g * g;
    moments[i] = moment;
    float rate = is_static ? now.static_lr : now.dynamic_lr;
    float denominator = sqrt(moment.y) / sqrt(now.bias_correction2) + setup.epsilon;
    params[i] -= rate / now.bias_correction1 * moment.x / denominator;
}

#version 450
#extension GL_GOOGLE_include_directive : require
// Adam's update of the parameters in f32. One invocation per parameter. The parameters of the dynamic field do not change while
// its start is delayed. The schedule sets the moments to zero before an update, for each field separately.
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
    // The update of a network is skipped while the dynamic field is delayed or if the gradient overflowed.
    bool of_network = !is_static || setup.two_networks != 0u;
    if (of_network && (now.dynamic_active == 0u || state.overflowed != 0u)) return;
    float g = gradient[i];
    FieldUpdate update = is_static ? now.static_update : now.dynamic_update;
    vec2 moment = update.restart != 0u ? vec2(0.0) : moments[i];
    moment.x = setup.beta1 * moment.x + (1.0 - setup.beta1) * g;
    moment.y = setup.beta2 * moment.y + (1.0 - setup.beta2) * g * g;
    moments[i] = moment;
    float denominator = sqrt(moment.y) / sqrt(update.bias_correction2) + setup.epsilon;
    params[i] -= update.rate / update.bias_correction1 * moment.x / denominator;
}

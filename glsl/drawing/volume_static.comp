#version 450
#extension GL_GOOGLE_include_directive : require
// Attenuation of the static field at the cells of a volume's rows; zero outside the field's box. One invocation per cell.
//   volume[row][n_dynamic_samples]; row: index of the ray in the batch.
#include "inc/operands.glsl"
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
#include "inc/softplus.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_rays; } push;
layout(binding = 0) SETUP B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
READ_VEC4(2, B2, static_params);
layout(binding = 3) writeonly buffer B3 { float volume[]; };
#include "inc/tensor_vm.glsl"

void main() {
    uint i = invocation();
    uint n = setup.n_dynamic_samples;
    if (i >= push.n_rays * n) return;
    Ray ray = rays[i / n];
    vec3 x = ray.anchor + grid_depth(i % n, n, setup.dynamic_near, setup.dynamic_far) * ray.direction;
    volume[i] = static_inside(x) ? static_attenuation(x) : 0.0;
}

// Read-only vec4 arrays, read the way that is fastest on a device (chosen in src/kernels/tuning.rs):
//   storage buffers           GPUs
//   -DTEXEL: texel buffers    lavapipe before Mesa 24, which reads storage buffers lane by lane
//   -DADDRESS: addresses      newer lavapipe, which then checks no bounds; for kernels whose push constants end in
//                             ADDRESS_OF(NAME) for each array
// To be included first: extensions precede all else.
#ifdef ADDRESS
#extension GL_EXT_buffer_reference : require
#extension GL_EXT_buffer_reference_uvec2 : require
layout(buffer_reference, std430, buffer_reference_align = 16) readonly buffer Vec4s { vec4 at[]; };
#define ADDRESS_OF(NAME) uvec2 NAME##_address;
#define FETCH(NAME, INDEX) Vec4s(push.NAME##_address).at[INDEX]
#else
#define ADDRESS_OF(NAME)
#endif
// SETUP: what a setup is, a uniform buffer, but for that old lavapipe where there are texel buffers: march_loss would take 1.6 times as
// long.
#ifdef TEXEL
#define SETUP readonly buffer
#define READ_VEC4(SLOT, BLOCK, NAME) layout(binding = SLOT) uniform samplerBuffer NAME
#define FETCH(NAME, INDEX) texelFetch(NAME, int(INDEX))
#else
#define SETUP uniform
#define READ_VEC4(SLOT, BLOCK, NAME) layout(binding = SLOT) readonly buffer BLOCK { vec4 NAME[]; }
#ifndef ADDRESS
#define FETCH(NAME, INDEX) NAME[INDEX]
#endif
#endif

// Read-only vec4 arrays with the access that is fastest on a device (chosen in src/kernels/tuning.rs):
//   storage buffers           GPUs
//   -DTEXEL: texel buffers    lavapipe before Mesa 24, which reads storage buffers lane by lane
//   -DADDRESS: addresses      newer lavapipe, which does not check bounds then; for kernels whose push constants end with
//     ADDRESS_OF(NAME) for each array
// This file must be included first, because it contains extensions.
#ifdef ADDRESS
#extension GL_EXT_buffer_reference : require
#extension GL_EXT_buffer_reference_uvec2 : require
layout(buffer_reference, std430, buffer_reference_align = 16) readonly buffer Vec4s { vec4 at[]; };
#define ADDRESS_OF(NAME) uvec2 NAME##_address;
#define FETCH(NAME, INDEX) Vec4s(push.NAME##_address).at[INDEX]
#else
#define ADDRESS_OF(NAME)
#endif
// SETUP is the storage class of a setup: a uniform buffer, except with texel buffers, because march_loss takes 1.6 times as
// long with a uniform buffer on the old lavapipe.
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

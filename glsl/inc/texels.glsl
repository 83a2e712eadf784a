// Read-only vec4 arrays. Old lavapipe (no uniform analysis) reads texel buffers several times faster
// than storage buffers; GPUs and newer lavapipe prefer storage buffers. -DTEXEL chooses.
#ifdef TEXEL
#define READ_VEC4(SLOT, BLOCK, NAME) layout(binding = SLOT) uniform samplerBuffer NAME
#define FETCH(NAME, INDEX) texelFetch(NAME, int(INDEX))
#else
#define READ_VEC4(SLOT, BLOCK, NAME) layout(binding = SLOT) readonly buffer BLOCK { vec4 NAME[]; }
#define FETCH(NAME, INDEX) NAME[INDEX]
#endif

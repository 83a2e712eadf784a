#version 450
#extension GL_GOOGLE_include_directive : require
// Pictures of X-Gaussian. The value of a pixel is the sum of c a T over the Gaussians of its tile, starting from the nearest.
// Here c is the intensity, a the opacity at the pixel, and T the transmittance of the Gaussians in front, which is the product
// of their (1 - a). An opacity below 1/255 counts as 0. The sum of a pixel ends before T falls below 1e-4. One workgroup per
// tile column (x), row (y) and set (z).
#include "inc/blend.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { BlendSetup blend_setup; };
layout(binding = 2) readonly buffer B2 { BlendGaussian blend_gaussians[]; };
layout(binding = 3) readonly buffer B3 { Splat splats[]; };
// [set][tile row][tile column]
layout(binding = 4) readonly buffer B4 { BlendList blend_lists[]; };
layout(binding = 5) readonly buffer B5 { uint blend_list_items[]; };
// [set][pixel] in fixed point, as read by later stages.
layout(binding = 6) writeonly buffer B6 { int splat_images[]; };
// [set][pixel]
layout(binding = 7) writeonly buffer B7 { BlendEnd blend_ends[]; };
#include "inc/blend_tile.glsl"

// Mean, opacity and intensity of the Gaussians in shared memory, followed by their conics.
shared vec4 places[LANES];
shared vec3 conics[LANES];
shared uint going;

// Maximum value of a picture, far above the values of targets. It keeps the fixed-point numbers in range.
const float BRIGHTEST = 256.0;

struct Pixel {
    float shown;
    float left;
    uint last;
    bool ended;
};

void add(uint j, uint place, vec2 at, inout Pixel pixel) {
    float alpha = alpha_of(conics[j], places[j].z, at - places[j].xy).alpha;
    if (alpha == 0.0) return;
    float left = pixel.left * (1.0 - alpha);
    if (left < MIN_LIGHT) {
        pixel.ended = true;
        return;
    }
    pixel.shown += places[j].w * alpha * pixel.left;
    pixel.left = left;
    pixel.last = place + 1u;
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    BlendList list = blend_lists[list_of_workgroup()];
    Pixel pixels[PIXELS_OF_LANE];
    for (uint k = 0u; k < PIXELS_OF_LANE; k++) pixels[k] = Pixel(0.0, 1.0, 0u, !is_in_image(pixel_of_lane(k)));
    for (uint begin = 0u; begin < list.count; begin += LANES) {
        barrier();
        if (lane == 0u) going = 0u;
        if (begin + lane < list.count) {
            uint i = blend_list_items[list.first + begin + lane];
            places[lane] = vec4(splats[i].mean, splats[i].amplitude, max(blend_gaussians[i].intensity, 0.0));
            conics[lane] = splats[i].conic;
        }
        barrier();
        for (uint k = 0u; k < PIXELS_OF_LANE; k++)
            if (!pixels[k].ended) atomicOr(going, 1u);
        barrier();
        if (going == 0u) break;
        uint n = min(LANES, list.count - begin);
        for (uint k = 0u; k < PIXELS_OF_LANE; k++) {
            vec2 at = vec2(pixel_of_lane(k));
            for (uint j = 0u; j < n && !pixels[k].ended; j++) add(j, begin + j, at, pixels[k]);
        }
    }
    for (uint k = 0u; k < PIXELS_OF_LANE; k++) {
        uvec2 pixel = pixel_of_lane(k);
        if (!is_in_image(pixel)) continue;
        float shown = min(pixels[k].shown, BRIGHTEST);
        splat_images[place_of(pixel)] = int(roundEven(shown * gaussian_setup.fixed_point));
        blend_ends[place_of(pixel)] = BlendEnd(pixels[k].left, pixels[k].last);
    }
}

#version 450
#extension GL_GOOGLE_include_directive : require
// Sums over a tile's pixels from which the gradient of each Gaussian in the tile's list is computed, from the last Gaussian to
// the first. Here g is the gradient with respect to the picture, T the transmittance in front of a Gaussian, a its opacity, c
// its intensity and B the value of the picture behind it. With h = g T (c - B) a where a depends on the parameters, the sums
// are those of h, h (du, dv), h (du^2, du dv, dv^2) and g T a. One workgroup per tile column (x), row (y) and set (z).
#include "inc/blend.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { BlendSetup blend_setup; };
layout(binding = 2) readonly buffer B2 { BlendGaussian blend_gaussians[]; };
layout(binding = 3) readonly buffer B3 { Splat splats[]; };
layout(binding = 4) readonly buffer B4 { BlendSpan blend_spans[]; };
// [set][tile row][tile column]
layout(binding = 5) readonly buffer B5 { BlendList blend_lists[]; };
layout(binding = 6) readonly buffer B6 { uint blend_list_items[]; };
// [set][pixel]
layout(binding = 7) readonly buffer B7 { BlendEnd blend_ends[]; };
layout(binding = 8) readonly buffer B8 { float splat_image_gradient[]; };
// [entry][7 sums]
layout(binding = 9) writeonly buffer B9 { float x_entries[]; };
#include "inc/blend_tile.glsl"

// Number of Gaussians whose sums are computed at once.
const uint BATCH = 8u;
const uint SUMS = 7u;
// Distance from the numbers of one sum to those of the next; its odd value avoids conflicts between memory banks.
const uint SUM_STRIDE = LANES + 1u;

// [Gaussian][sum][lane]
shared float parts[BATCH * SUMS * SUM_STRIDE];
// Mean, opacity and intensity of the batch's Gaussians, followed by their conics and the entries of their sums.
shared vec4 places[BATCH];
shared vec3 conics[BATCH];
shared uint entries[BATCH];
// One more than the position of the last Gaussian that is visible in any pixel of the tile.
shared uint last_shown;

struct Pixel {
    vec2 at;
    float gradient;
    float light;
    float behind;
    uint last;
};

Pixel pixel_to_go_back(uint k) {
    uvec2 pixel = pixel_of_lane(k);
    if (!is_in_image(pixel)) return Pixel(vec2(0.0), 0.0, 1.0, 0.0, 0u);
    uint place = place_of(pixel);
    float gradient = blend_setup.absolute_weight * splat_image_gradient[place];
    return Pixel(vec2(pixel), gradient, blend_ends[place].left, 0.0, blend_ends[place].last);
}

uint entry_of(uint i) {
    BlendSpan span = blend_spans[i];
    uvec2 from_first = gl_WorkGroupID.xy - uvec2(span.first & 0xffffu, span.first >> 16);
    return span.first_entry + from_first.y * columns_and_rows(span).x + from_first.x;
}

// Writes zeros for the Gaussians behind the last visible one, which do not contribute.
void clear_hidden(BlendList list) {
    for (uint k = last_shown + gl_LocalInvocationID.x; k < list.count; k += LANES) {
        uint entry = entry_of(blend_list_items[list.first + k]);
        for (uint s = 0u; s < SUMS; s++) x_entries[entry * SUMS + s] = 0.0;
    }
}

// Moves a pixel's state from behind the `j`-th Gaussian of the batch to in front of it.
void pass(uint j, inout Pixel pixel, inout float sums[SUMS]) {
    vec2 d = pixel.at - places[j].xy;
    XAlpha here = alpha_of(conics[j], places[j].z, d);
    if (here.alpha == 0.0) return;
    float intensity = places[j].w;
    pixel.light /= 1.0 - here.alpha;
    float by_alpha = pixel.gradient * pixel.light * (intensity - pixel.behind);
    pixel.behind = mix(pixel.behind, intensity, here.alpha);
    sums[6] += pixel.gradient * pixel.light * here.alpha;
    if (!here.follows) return;
    float h = by_alpha * here.alpha;
    sums[0] += h;
    sums[1] += h * d.x;
    sums[2] += h * d.y;
    sums[3] += h * d.x * d.x;
    sums[4] += h * d.x * d.y;
    sums[5] += h * d.y * d.y;
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    BlendList list = blend_lists[list_of_workgroup()];
    if (lane == 0u) last_shown = 0u;
    barrier();
    Pixel pixels[PIXELS_OF_LANE];
    for (uint k = 0u; k < PIXELS_OF_LANE; k++) {
        pixels[k] = pixel_to_go_back(k);
        atomicMax(last_shown, pixels[k].last);
    }
    barrier();
    clear_hidden(list);
    for (uint batch = (last_shown + BATCH - 1u) / BATCH; batch-- > 0u;) {
        uint begin = batch * BATCH, n = min(BATCH, last_shown - begin);
        if (lane < n) {
            uint i = blend_list_items[list.first + begin + lane];
            places[lane] = vec4(splats[i].mean, splats[i].amplitude, max(blend_gaussians[i].intensity, 0.0));
            conics[lane] = splats[i].conic;
            entries[lane] = entry_of(i);
        }
        barrier();
        for (uint j = n; j-- > 0u;) {
            float sums[SUMS];
            for (uint s = 0u; s < SUMS; s++) sums[s] = 0.0;
            for (uint k = 0u; k < PIXELS_OF_LANE; k++)
                if (begin + j < pixels[k].last) pass(j, pixels[k], sums);
            for (uint s = 0u; s < SUMS; s++) parts[(j * SUMS + s) * SUM_STRIDE + lane] = sums[s];
        }
        barrier();
        if (lane < n * SUMS) {
            float sum = 0.0;
            for (uint k = 0u; k < LANES; k++) sum += parts[lane * SUM_STRIDE + k];
            x_entries[entries[lane / SUMS] * SUMS + lane % SUMS] = sum;
        }
        barrier();
    }
}

// Projection of Gaussians in a cone beam. Reference implementation: crates/twins/src/reference/gaussians.rs.
#include "inc/gaussian_layout.glsl"

// Splat of a Gaussian, and the intermediate results from which its gradient is computed.
struct Projection {
    Splat splat;
    float depth;
    vec3 ray;
    vec3 column_slope;
    vec3 row_slope;
    // Slopes along the Gaussian's axes times its scales.
    vec3 alpha;
    vec3 beta;
    vec3 scale;
    mat3 axes;
};

mat3 rotation_matrix(vec4 unit) {
    float w = unit.x, x = unit.y, y = unit.z, z = unit.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

const float SQRT_TWO_PI = 2.50662827463;

// The projection is affine around the centre. Its difference from the exact cone beam is below the effect of the cut.
Projection project(Gaussian g, vec3 position, GaussianView view, GaussianSetup setup) {
    Projection p;
    vec4 x = vec4(position, 1.0);
    p.depth = dot(view.depth, x);
    float z = p.depth;
    vec2 mean = vec2(dot(view.column, x), dot(view.row, x)) / z;
    p.column_slope = (view.column.xyz - mean.x * view.depth.xyz) / z;
    p.row_slope = (view.row.xyz - mean.y * view.depth.xyz) / z;
    p.ray = view.d0.xyz + mean.x * view.du.xyz + mean.y * view.dv.xyz;
    p.axes = rotation_matrix(normalize(g.rotation));
    vec3 sharp = clamp(exp(g.log_scale), setup.min_scale, setup.max_scale);
    // Blurred images have equal mass in wider Gaussians.
    p.scale = setup.blur > 0.0 ? sqrt(sharp * sharp + setup.blur * setup.blur) : sharp;
    p.alpha = p.scale * (p.column_slope * p.axes);
    p.beta = p.scale * (p.row_slope * p.axes);
    vec3 variance = vec3(dot(p.alpha, p.alpha), dot(p.alpha, p.beta), dot(p.beta, p.beta));
    float det = dot(cross(p.alpha, p.beta), cross(p.alpha, p.beta));
    p.splat.mean = mean;
    p.splat.conic = vec3(variance.z, -variance.y, variance.x) / det;
    float volume = sharp.x * sharp.y * sharp.z;
    p.splat.amplitude = exp(g.log_density) * SQRT_TWO_PI * volume * length(p.ray) * view.d0.w / (z * z * sqrt(det));
    p.splat.half_box = setup.cut * sqrt(variance.xz);
    // A Gaussian behind the source is not visible.
    if (!(z > 0.0)) p.splat.half_box = vec2(-1.0);
    return p;
}

// First and last column and row (inclusive) of the box inside the image; the box is empty if last < first.
ivec4 pixels_of(Splat splat, GaussianSetup setup) {
    vec2 first = max(ceil(splat.mean - splat.half_box), vec2(0.0));
    vec2 last = min(floor(splat.mean + splat.half_box), vec2(float(setup.width) - 1.0, float(setup.height) - 1.0));
    if (!(last.x >= first.x && last.y >= first.y)) return ivec4(0, 0, -1, -1);
    return ivec4(ivec2(first), ivec2(last));
}

uint n_pixels(ivec4 box) {
    return uint(max(box.z - box.x + 1, 0) * max(box.w - box.y + 1, 0));
}

// Value exp(-q / 2) at a pixel; `half_log2` is the conic times -log2(e) / 2.
float falloff(vec3 half_log2, vec2 d) {
    return exp2(d.x * (half_log2.x * d.x + 2.0 * half_log2.y * d.y) + half_log2.z * d.y * d.y);
}

const float HALF_LOG2_E = 0.72134752044;

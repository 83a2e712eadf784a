// Projection of the Gaussians of X-Gaussian in a cone beam, with the intermediate results from which their gradient is
// computed. Reference implementation: src/methods/x_gaussian/twin.rs.
#include "inc/gaussian.glsl"
#include "inc/gaussian_gradient.glsl"
#include "inc/r2_layout.glsl"
#include "inc/softplus.glsl"
#include "inc/x_layout.glsl"

// Distance from the image's middle, in half images, at which the slopes of a projection are limited. A centre further outside
// has the slopes at this border.
const float SLOPES_END = 1.3;
// Minimum squared difference of a splat's variances along its axes, pixels^4, in the computation of its radius.
const float MIN_SPREAD = 0.1;
// Variance that is added to each splat, pixels^2.
const float LOW_PASS = 0.3;
// Radius of a splat in standard deviations along its longest axis.
const float REACH = 3.0;
// Pixels along each side of a tile.
const uint TILE = 16u;
// Sort key of a Gaussian that is not visible, behind all depths.
const uint UNSEEN = 0xffffffffu;
// Maximum opacity of a Gaussian in a pixel.
const float MAX_OPAQUE = 0.99;
// Opacity below which a Gaussian is not drawn in a pixel.
const float MIN_ALPHA = 1.0 / 255.0;
// Transmittance below which the sum of a pixel ends.
const float MIN_LIGHT = 1e-4;

struct XProjection {
    Splat splat;
    float depth;
    // Per image axis, 1 if the slopes are those at the centre itself, 0 if they are those at the border.
    vec2 follows;
    vec3 column_slope;
    vec3 row_slope;
    // Slopes along the Gaussian's axes times its scales.
    vec3 alpha;
    vec3 beta;
    vec3 scale;
    mat3 axes;
};

// The splat's amplitude is its opacity, and its box is the square of its radius.
XProjection project_x(XGaussian g, GaussianView view, GaussianSetup setup, XSetup x_setup) {
    XProjection p;
    vec4 x = vec4(g.position, 1.0);
    p.depth = dot(view.depth, x);
    float z = p.depth;
    vec2 mean = vec2(dot(view.column, x), dot(view.row, x)) / z;
    vec2 size = vec2(float(setup.width), float(setup.height));
    vec2 middle = 0.5 * (size - 1.0);
    vec2 held = clamp(mean, middle - 0.5 * SLOPES_END * size, middle + 0.5 * SLOPES_END * size);
    p.follows = vec2(equal(held, mean));
    p.column_slope = (view.column.xyz - held.x * view.depth.xyz) / z;
    p.row_slope = (view.row.xyz - held.y * view.depth.xyz) / z;
    p.axes = rotation_matrix(normalize(g.rotation));
    p.scale = exp(g.log_scale);
    p.alpha = p.scale * (p.column_slope * p.axes);
    p.beta = p.scale * (p.row_slope * p.axes);
    vec3 sharp = vec3(dot(p.alpha, p.alpha), dot(p.alpha, p.beta), dot(p.beta, p.beta));
    vec3 variance = sharp + LOW_PASS * vec3(1.0, 0.0, 1.0);
    vec3 across = cross(p.alpha, p.beta);
    float det = dot(across, across) + LOW_PASS * (sharp.x + sharp.z + LOW_PASS);
    p.splat.mean = mean;
    p.splat.conic = vec3(variance.z, -variance.y, variance.x) / det;
    p.splat.amplitude = sigmoid(g.opacity);
    float half_sum = 0.5 * (variance.x + variance.z);
    float largest = half_sum + sqrt(max(MIN_SPREAD, half_sum * half_sum - det));
    p.splat.half_box = vec2(ceil(REACH * sqrt(largest)));
    // A Gaussian at the source or behind it is not visible.
    if (!(z > x_setup.nearest)) p.splat.half_box = vec2(-1.0);
    return p;
}

// First tile (column, row) that the splat's square touches, and one more than the last; they are equal if it touches none.
uvec4 tiles_of(Splat splat, XSetup x_setup) {
    if (!(splat.half_box.x > 0.0)) return uvec4(0u);
    vec2 tiles = vec2(float(x_setup.tile_columns), float(x_setup.tile_rows));
    vec2 first = clamp(trunc((splat.mean - splat.half_box) / float(TILE)), vec2(0.0), tiles);
    vec2 end = clamp(trunc((splat.mean + splat.half_box + float(TILE - 1u)) / float(TILE)), vec2(0.0), tiles);
    return any(lessThanEqual(end, first)) ? uvec4(0u) : uvec4(uvec2(first), uvec2(end));
}

uvec2 columns_and_rows(XSpan span) {
    return uvec2((span.end & 0xffffu) - (span.first & 0xffffu), (span.end >> 16) - (span.first >> 16));
}

// Opacity of a splat in a pixel, and whether the opacity depends on the splat's parameters there.
struct XAlpha {
    float alpha;
    bool follows;
};

// `d` is the vector from the centre to the pixel.
XAlpha alpha_of(vec3 conic, float opacity, vec2 d) {
    float alpha = opacity * falloff(-HALF_LOG2_E * conic, d);
    if (alpha > MAX_OPAQUE) return XAlpha(MAX_OPAQUE, false);
    return XAlpha(alpha < MIN_ALPHA ? 0.0 : alpha, true);
}

// Gradient with respect to position, opacity (in `log_density`), logarithms of scales, and raw quaternion. With h = dL/d(ln
// alpha) where alpha depends on the parameters, `linear` = h (1, du, dv) and `square` = h (du^2, du dv, dv^2), summed over the
// pixels.
GaussianGradient gradient_x(XGaussian g, XProjection p, GaussianView view, vec3 linear, vec3 square) {
    mat2 conic = mat2(p.splat.conic.x, p.splat.conic.y, p.splat.conic.y, p.splat.conic.z);
    mat2 second = mat2(square.x, square.y, square.y, square.z);
    mat2 variance = 0.5 * (conic * second * conic);
    vec3 d_alpha = 2.0 * (variance[0][0] * p.alpha + variance[0][1] * p.beta);
    vec3 d_beta = 2.0 * (variance[0][1] * p.alpha + variance[1][1] * p.beta);
    vec3 d_column_slope = p.axes * (p.scale * d_alpha);
    vec3 d_row_slope = p.axes * (p.scale * d_beta);
    float z = p.depth;
    // Contribution of the slopes where they depend on the centre.
    vec2 d_held = -vec2(dot(view.depth.xyz, d_column_slope), dot(view.depth.xyz, d_row_slope)) / z;
    vec2 d_mean = conic * linear.yz + p.follows * d_held;
    float d_depth = -(dot(p.column_slope, d_column_slope) + dot(p.row_slope, d_row_slope)) / z;
    vec3 column = (view.column.xyz - p.splat.mean.x * view.depth.xyz) / z;
    vec3 row = (view.row.xyz - p.splat.mean.y * view.depth.xyz) / z;
    GaussianGradient gradient;
    gradient.position = d_mean.x * column + d_mean.y * row + d_depth * view.depth.xyz;
    gradient.log_density = linear.x * (1.0 - p.splat.amplitude);
    gradient.log_scale = p.alpha * d_alpha + p.beta * d_beta;
    mat3 d_axes;
    for (int k = 0; k < 3; k++)
        d_axes[k] = p.scale[k] * (d_alpha[k] * p.column_slope + d_beta[k] * p.row_slope);
    gradient.rotation = rotation_gradient(g.rotation, d_axes);
    return gradient;
}

// Projection in a cone beam of Gaussians of which nearer ones hide those behind them, with the intermediate results from which their
// gradient is computed. Reference implementation: src/methods/x_gaussian/twin.rs.
#include "inc/blend_layout.glsl"
#include "inc/gaussian.glsl"
#include "inc/gaussian_gradient.glsl"
#include "inc/local_projection.glsl"
#include "inc/picture_layout.glsl"
#include "inc/softplus.glsl"

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

struct BlendProjection {
    LocalProjection at;
    Splat splat;
};

// The splat's amplitude is its opacity, and its box is the square of its radius.
BlendProjection project_blended(BlendGaussian g, GaussianView view, GaussianSetup setup, BlendSetup blend_setup) {
    BlendProjection p;
    p.at = project_locally(g.position, g.rotation, exp(g.log_scale), view, setup);
    vec3 sharp = variance_of(p.at);
    vec3 variance = sharp + LOW_PASS * vec3(1.0, 0.0, 1.0);
    vec3 across = cross(p.at.alpha, p.at.beta);
    float det = dot(across, across) + LOW_PASS * (sharp.x + sharp.z + LOW_PASS);
    p.splat.mean = p.at.mean;
    p.splat.conic = vec3(variance.z, -variance.y, variance.x) / det;
    p.splat.amplitude = sigmoid(g.opacity);
    p.splat.half_box = vec2(ceil(REACH * sqrt(largest_variance(variance, det))));
    // A Gaussian at the source or behind it is not visible.
    if (!(p.at.depth > blend_setup.nearest)) p.splat.half_box = vec2(-1.0);
    return p;
}

// First tile (column, row) that the splat's square touches, and one more than the last; they are equal if it touches none.
uvec4 tiles_of(Splat splat, BlendSetup blend_setup) {
    if (!(splat.half_box.x > 0.0)) return uvec4(0u);
    vec2 tiles = vec2(float(blend_setup.tile_columns), float(blend_setup.tile_rows));
    vec2 first = clamp(trunc((splat.mean - splat.half_box) / float(TILE)), vec2(0.0), tiles);
    vec2 end = clamp(trunc((splat.mean + splat.half_box + float(TILE - 1u)) / float(TILE)), vec2(0.0), tiles);
    return any(lessThanEqual(end, first)) ? uvec4(0u) : uvec4(uvec2(first), uvec2(end));
}

uvec2 columns_and_rows(BlendSpan span) {
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
GaussianGradient gradient_x(BlendGaussian g, BlendProjection p, GaussianView view, vec3 linear, vec3 square) {
    mat2 conic = mat2(p.splat.conic.x, p.splat.conic.y, p.splat.conic.y, p.splat.conic.z);
    mat2 second = mat2(square.x, square.y, square.y, square.z);
    mat2 variance = 0.5 * (conic * second * conic);
    vec3 d_alpha = 2.0 * (variance[0][0] * p.at.alpha + variance[0][1] * p.at.beta);
    vec3 d_beta = 2.0 * (variance[0][1] * p.at.alpha + variance[1][1] * p.at.beta);
    vec3 d_column_slope = p.at.axes * (p.at.scale * d_alpha);
    vec3 d_row_slope = p.at.axes * (p.at.scale * d_beta);
    float z = p.at.depth;
    // Contribution of the slopes where they depend on the centre.
    vec2 d_held = -vec2(dot(view.depth.xyz, d_column_slope), dot(view.depth.xyz, d_row_slope)) / z;
    vec2 d_mean = conic * linear.yz + p.at.follows * d_held;
    float d_depth = -(dot(p.at.column_slope, d_column_slope) + dot(p.at.row_slope, d_row_slope)) / z;
    vec3 column = (view.column.xyz - p.splat.mean.x * view.depth.xyz) / z;
    vec3 row = (view.row.xyz - p.splat.mean.y * view.depth.xyz) / z;
    GaussianGradient gradient;
    gradient.position = d_mean.x * column + d_mean.y * row + d_depth * view.depth.xyz;
    gradient.log_density = linear.x * (1.0 - p.splat.amplitude);
    gradient.log_scale = p.at.alpha * d_alpha + p.at.beta * d_beta;
    mat3 d_axes;
    for (int k = 0; k < 3; k++)
        d_axes[k] = p.at.scale[k] * (d_alpha[k] * p.at.column_slope + d_beta[k] * p.at.row_slope);
    gradient.rotation = rotation_gradient(g.rotation, d_axes);
    return gradient;
}

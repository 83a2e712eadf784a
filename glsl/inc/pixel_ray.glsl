// Ray through a pixel's centre: anchor at the isocentre plane, direction of unit depth. The including file must declare `View`.
struct Line {
    vec3 anchor;
    vec3 direction;
};

Line line_through(View view, uint pixel, uint image_width) {
    float i = float(pixel % image_width);
    float j = float(pixel / image_width);
    return Line(view.anchor00.xyz + i * view.anchor_du.xyz + j * view.anchor_dv.xyz,
                view.direction00.xyz + i * view.direction_du.xyz + j * view.direction_dv.xyz);
}

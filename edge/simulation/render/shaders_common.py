"""GLSL shared by all programs: vertex stages, noise lookups, sky, light and haze.

Texture is looked up by model position and the instance's seed, never by screen position, so left and right
see the same marks. The level of detail follows from distance alone (no screen derivatives), for the same
reason. Texture taps are what a CPU rasteriser pays most for: each lookup serves all four noise channels.
"""

from __future__ import annotations

VERSION = "#version 410\n"

INSTANCE_INPUTS = """
in vec3 in_position;
in vec4 in_row0;
in vec4 in_row1;
in vec4 in_row2;
in vec4 in_tint_seed;
vec3 placed(vec3 p) {
    vec4 q = vec4(p, 1.0);
    return vec3(dot(in_row0, q), dot(in_row1, q), dot(in_row2, q));
}
"""

COLOUR_VERTEX = (
    VERSION
    + INSTANCE_INPUTS
    + """
uniform mat4 u_clip_from_world;
in vec3 in_normal;
in vec3 in_colour;
in float in_material;
out vec3 v_world;
out vec3 v_model;
out vec3 v_normal;
out vec3 v_colour;
flat out vec3 v_facing;   // model-frame normal: chooses the texture plane
flat out float v_seed;
flat out int v_material;
void main() {
    v_world = placed(in_position);
    v_model = in_position;
    vec3 r0 = in_row0.xyz, r1 = in_row1.xyz, r2 = in_row2.xyz;
    vec3 c0 = cross(r1, r2);
    float handed = dot(r0, c0) < 0.0 ? -1.0 : 1.0;
    vec3 c1 = cross(r2, r0), c2 = cross(r0, r1);   // cofactors: normals under uneven scale
    v_normal = handed * vec3(dot(c0, in_normal), dot(c1, in_normal), dot(c2, in_normal));
    v_material = int(in_material + 0.5);
    bool tinted = v_material == 1 || v_material == 12;
    v_colour = tinted ? in_colour * in_tint_seed.xyz : in_colour;
    v_facing = in_normal;
    v_seed = in_tint_seed.w;
    gl_Position = u_clip_from_world * vec4(v_world, 1.0);
}
"""
)

NOISE = """
uniform sampler2D u_noise;
uniform float u_metres_per_pixel_at_1m;
const float NOISE_TEXELS = 512.0;
float hash2(vec2 p) {
    p = fract(p * vec2(0.1031, 0.1030) + 0.37);
    p += dot(p, p.yx + 33.33);
    return fract((p.x + p.y) * p.y * 7.31);
}
vec2 seeded(float seed) { return vec2(fract(seed * 0.61803399), fract(seed * 0.75487767 + 0.3)) * 61.0; }
// texture of a tile that spans `metres`, at a surface seen with `footprint` metres a pixel
vec4 noise(vec2 p, float metres, float footprint) {
    float lod = log2(max(footprint * NOISE_TEXELS / metres, 1e-4));
    return textureLod(u_noise, p / metres, lod);
}
vec2 planar(vec3 p, vec3 n) {
    vec3 a = abs(n);
    if (a.y >= max(a.x, a.z)) return p.xz;
    return a.x > a.z ? vec2(p.z, p.y) : vec2(p.x, p.y);
}
"""

FOLIAGE_COVER = """
struct Leaves { vec4 fine; vec4 clump; float cover; };
// cover 0..1: how much of the leaf layer covers this spot; outlines (facing 0) are more ragged than middles
Leaves leaves_at(vec3 p, vec3 facing_axis, float seed, float footprint, float facing) {
    vec2 s = seeded(seed);
    Leaves l;
    vec2 uv = planar(p, facing_axis) + s;
    l.fine = noise(uv, 1.15, footprint);
    l.clump = noise(uv.yx - 2.0 * s, 5.3, footprint);
    float edge = l.fine.a * 0.45 + l.clump.a * 0.25 + l.clump.r * 0.30;
    float cut_at = mix(0.52, 0.22, clamp(facing * 1.7, 0.0, 1.0));
    float soft = clamp(footprint * 1.5, 0.03, 0.4);
    float cut = smoothstep(cut_at - soft, cut_at + soft, edge);
    l.cover = mix(cut, 0.9 - 2.0 * max(cut_at - 0.4, 0.0), smoothstep(0.06, 0.2, footprint));
    return l;
}
"""

SKY = """
uniform vec3 u_sun;
uniform vec3 u_sun_rgb;
uniform vec3 u_zenith;
uniform vec3 u_horizon;
uniform float u_cloud_cover;
uniform float u_haze_per_m;
uniform float u_exposure;
uniform float u_sun_share;   // of direct light that passes the clouds
vec3 sky_gradient(vec3 d) {
    float up = max(-d.y, 0.0);
    vec3 clear = mix(u_zenith, u_horizon, exp2(-up * 5.5));
    vec3 grey = mix(vec3(0.62, 0.66, 0.72), vec3(0.95), 0.3 + 0.5 * up);
    float luminance = dot(u_horizon, vec3(0.25, 0.6, 0.15));
    return mix(clear, grey * luminance, smoothstep(0.45, 1.0, u_cloud_cover) * 0.9);
}
vec3 sun_glow(vec3 d) {
    float c = max(dot(d, u_sun), 0.0);
    float c8 = c * c; c8 *= c8; c8 *= c8;
    float c64 = c8 * c8; c64 *= c64; c64 *= c64;
    return u_sun_rgb * (0.05 * c8 + 0.22 * c64) * (0.35 + 0.65 * u_sun_share);
}
uniform vec3 u_air;   // the sky low over the horizon
vec3 with_haze(vec3 radiance, vec3 direction, float distance_m) {
    float through = exp2(-1.4427 * u_haze_per_m * distance_m);
    float c = max(dot(direction, u_sun), 0.0);
    c *= c; c *= c;
    return mix(u_air + u_sun_rgb * (0.05 * c * u_sun_share), radiance, through);
}
"""

LIGHT = """
uniform sampler2DShadow u_shadow;
uniform mat4 u_shadow_from_world;
uniform float u_shadow_texel;
uniform float u_shadow_spread;
uniform sampler2D u_cover;         // height of what stands over the ground, from above, blurred by mip level
uniform mat4 u_cover_from_world;
float sun_visibility(vec3 world, vec3 n) {
    vec4 p = u_shadow_from_world * vec4(world + n * 0.06, 1.0);
    vec3 q = p.xyz * 0.5 + 0.5;
    q.z -= 0.0004;
    float r = u_shadow_texel * u_shadow_spread;
    float lit = texture(u_shadow, q + vec3(-r, -0.4 * r, 0.0)) + texture(u_shadow, q + vec3(r, 0.4 * r, 0.0));
    vec2 inside = clamp((0.5 - abs(q.xy - 0.5)) * 25.0, 0.0, 1.0);
    return mix(1.0, lit * 0.5, inside.x * inside.y);
}
// share of the sky that a spot sees: less beneath and beside what stands near
float sky_visibility(vec3 world, vec3 n) {
    vec3 q = (u_cover_from_world * vec4(world + n * 0.25, 1.0)).xyz;
    vec2 uv = q.xy * 0.5 + 0.5;
    float above = clamp(textureLod(u_cover, uv, 2.0).r - q.z, 0.0, 2.5);
    vec2 inside = clamp((1.0 - abs(q.xy)) * 10.0, 0.0, 1.0);
    return mix(1.0, 1.0 / (1.0 + 1.3 * above), inside.x * inside.y);
}
uniform vec3 u_bounce;   // light from below
uniform vec3 u_dome;     // light from above, without the sun
vec3 sky_light(vec3 n) {
    float up = 0.5 - 0.5 * n.y;
    return mix(u_bounce, u_dome, up);
}
"""

COLOUR_INPUTS = """
uniform vec3 u_eye;
in vec3 v_world;
in vec3 v_model;
in vec3 v_normal;
in vec3 v_colour;
flat in vec3 v_facing;
flat in float v_seed;
flat in int v_material;
out vec4 out_radiance;
const float BRIGHTEST = 12.0;   // clipped before samples are averaged, so that glints keep smooth edges
struct Spot { vec3 view; float distance_m; float footprint; vec3 n; };
Spot spot_here() {
    Spot s;
    vec3 ray = v_world - u_eye;
    s.distance_m = length(ray);
    s.view = ray / s.distance_m;
    s.footprint = s.distance_m * u_metres_per_pixel_at_1m;
    s.n = normalize(v_normal);
    if (dot(s.n, s.view) > 0.15) s.n = -s.n;
    return s;
}
vec3 diffuse_light(vec3 world, vec3 n, float occlusion) {
    float facing_sun = max(dot(n, u_sun), 0.0);
    vec3 sun = u_sun_rgb * (u_sun_share * facing_sun * sun_visibility(world, n));
    return sun + sky_light(n) * (sky_visibility(world, n) * occlusion);
}
void finish(vec3 radiance, Spot s) {
    vec3 hazy = with_haze(radiance, s.view, s.distance_m) * u_exposure;
    out_radiance = vec4(min(hazy, vec3(BRIGHTEST)), 1.0);
}
"""

COLOUR_PREAMBLE = VERSION + NOISE + SKY + LIGHT + COLOUR_INPUTS

SKY_VERTEX = (
    VERSION
    + """
in vec2 in_corner;
uniform mat3 u_rays_from_clip;
out vec3 v_ray;
void main() {
    v_ray = u_rays_from_clip * vec3(in_corner, 1.0);
    gl_Position = vec4(in_corner, 1.0, 1.0);
}
"""
)

SKY_FRAGMENT = (
    VERSION
    + NOISE
    + SKY
    + """
uniform vec2 u_sky_shift;
uniform vec3 u_bounce;
in vec3 v_ray;
out vec4 out_radiance;
void main() {
    vec3 d = normalize(v_ray);
    float up = max(-d.y, 0.0);
    vec3 radiance = sky_gradient(d);
    // below the horizon, beyond the ground that was built: open land in haze
    float land_distance_m = 1.65 / max(d.y, 0.0005);
    vec3 land = mix(u_air, u_bounce * vec3(0.8, 0.95, 0.5), exp2(-1.4427 * u_haze_per_m * land_distance_m));
    radiance = mix(radiance, land, clamp(d.y * 300.0, 0.0, 1.0));
    vec2 p = d.xz / (up + 0.09) + u_sky_shift;
    float far = clamp(0.0025 / ((up + 0.09) * (up + 0.09)), 0.002, 0.5);
    float body = noise(p, 9.0, far).r * 0.68 + noise(p * 1.07 + 3.1, 2.1, far).g * 0.32;
    float lit_side = noise(p + u_sun.xz * 0.10, 9.0, far * 2.0).r;
    float edge = 0.86 - 0.78 * u_cloud_cover;
    float cloud = smoothstep(edge - 0.10, edge + 0.20, body) * smoothstep(0.0, 0.10, up);
    float luminance = dot(u_horizon, vec3(0.25, 0.6, 0.15));
    float shade = smoothstep(0.3, 1.0, lit_side) * (0.5 + 0.5 * u_cloud_cover);
    vec3 white = luminance * (vec3(1.25, 1.24, 1.22) - vec3(0.6, 0.57, 0.52) * shade);
    radiance = mix(radiance, white, cloud * (0.85 - 0.25 * smoothstep(0.7, 1.0, u_cloud_cover)));
    radiance += sun_glow(d) * (1.0 - 0.6 * cloud);
    float disc = smoothstep(0.99990, 0.99996, dot(d, u_sun));
    radiance += u_sun_rgb * 20.0 * disc * u_sun_share * (1.0 - cloud);
    out_radiance = vec4(min(radiance * u_exposure, vec3(12.0)), 1.0);
}
"""
)

PLAIN_VERTEX = (
    VERSION
    + INSTANCE_INPUTS
    + """
uniform mat4 u_clip_from_world;
in int in_object_id;
in vec3 in_normal;
out vec3 v_world;
out vec3 v_model;
out vec3 v_normal;
flat out vec3 v_facing;
flat out float v_seed;
flat out int v_object_id;
void main() {
    v_world = placed(in_position);
    v_normal = vec3(dot(in_row0.xyz, in_normal), dot(in_row1.xyz, in_normal), dot(in_row2.xyz, in_normal));
    v_model = in_position;
    v_facing = in_normal;
    v_seed = in_tint_seed.w;
    v_object_id = in_object_id;
    gl_Position = u_clip_from_world * vec4(v_world, 1.0);
}
"""
)

IDENTITY_FRAGMENT = """
flat in int v_object_id;
out ivec2 out_identity_depth;
void main() {
    CUT
    out_identity_depth = ivec2(v_object_id, floatBitsToInt(1.0 / gl_FragCoord.w));
}
"""

SHADOW_FRAGMENT = """
void main() {
    CUT
}
"""

HEIGHT_FRAGMENT = """
uniform float u_highest;
in vec3 v_world;
out float out_height;
void main() {
    CUT
    out_height = min(-v_world.y, u_highest);
}
"""

LEAF_INPUTS = """
uniform vec3 u_eye;
in vec3 v_model;
in vec3 v_normal;
flat in vec3 v_facing;
flat in float v_seed;
"""


def solid(fragment: str) -> str:
    """A geometry-only fragment stage for closed surfaces."""
    return VERSION + fragment.replace("CUT", "")


def leafy(fragment: str, *, footprint: str, facing: str) -> str:
    """The same with holes between leaves; GLSL expressions give metres a pixel and how much a spot faces."""
    inputs = LEAF_INPUTS + ("" if "in vec3 v_world" in fragment else "in vec3 v_world;\n")
    cut = f"if (leaves_at(v_model, v_facing, v_seed, {footprint}, {facing}).cover < 0.5) discard;"
    return VERSION + NOISE + FOLIAGE_COVER + inputs + fragment.replace("CUT", cut)

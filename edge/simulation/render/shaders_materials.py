"""GLSL of the surface kinds, grouped into programs.

A CPU rasteriser runs both sides of every branch, so one large program would pay for all materials at every
pixel; each group of alike materials has its own.
"""

from __future__ import annotations

from edge.simulation.render.shaders_common import COLOUR_PREAMBLE, FOLIAGE_COVER
from edge.simulation.scene import Material

REFLECTION = """
// what a glossy surface sees in a direction: sky, a dark skyline, the road
vec3 surroundings(vec3 d, float roughness) {
    float skyline = 0.08 + 0.14 * noise(vec2(d.x - d.z * 0.6, d.z + d.x * 0.3), 3.0, 0.01).r;
    float up = -d.y;
    float soft = 0.03 + roughness;
    vec3 low = mix(u_bounce * 1.3, u_dome * 0.34, clamp(up / soft + 0.5, 0.0, 1.0));
    return mix(low, sky_gradient(d) + sun_glow(d) * 0.5, smoothstep(skyline - soft, skyline + soft, up));
}
float sun_highlight(vec3 n, vec3 view, float power) {
    vec3 h = normalize(u_sun - view);
    return pow(max(dot(n, h), 0.0), power);
}
float fresnel(vec3 n, vec3 view, float base) {
    float c = 1.0 - clamp(dot(n, -view), 0.0, 1.0);
    float c2 = c * c;
    return base + (1.0 - base) * c2 * c2 * c;
}
"""

PLAIN = (
    REFLECTION
    + """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing) + seeded(v_seed);
    vec4 a = noise(uv, 0.9, s.footprint);
    vec4 b = noise(uv + 7.0, 3.1, s.footprint);
    float fine = a.r - 0.5, grain = a.b - 0.5, broad = b.g - 0.5;
    float gain, gloss = 0.0;
    vec3 albedo = v_colour;
    if (v_material == 9) {            // bark: furrows along the trunk
        // round the trunk the texture follows the turn, so that no facet starts it anew
        float turn = atan(v_model.z, v_model.x);
        vec4 rind = noise(vec2(turn * 0.35, v_model.y * 0.22) + seeded(v_seed), 0.8, s.footprint * 1.5);
        gain = 0.62 + 1.3 * (rind.a - 0.4) + 0.7 * (rind.b - 0.5) + 0.5 * broad + 0.3 * grain;
        float moss = smoothstep(0.55, 0.8, b.g) * step(0.5, fract(v_seed * 3.7));
        albedo = mix(albedo, albedo * vec3(0.75, 1.15, 0.6), moss);
    } else if (v_material == 12) {    // cloth: weave, folds
        gain = 1.0 + 0.4 * fine + 0.35 * broad + 0.15 * grain;
    } else if (v_material == 11) {    // skin
        gain = 1.0 + 0.15 * fine;
    } else if (v_material == 3) {     // rubber
        gain = 1.0 + 0.3 * grain + 0.4 * fine; gloss = 0.15;
    } else if (v_material == 13) {    // lamp: clear cover over a bright bowl
        gain = 1.0 + 0.5 * grain + 0.3 * fine; gloss = 1.0;
    } else if (v_material == 15) {    // sign
        gain = 1.0 + 0.10 * broad; gloss = 0.3;
    } else {
        gain = 1.0 + 0.30 * fine + 0.35 * broad + 0.2 * grain;
    }
    vec3 radiance = albedo * (max(gain, 0.05) * diffuse_light(v_world, s.n, 1.0));
    radiance += surroundings(reflect(s.view, s.n), 0.2) * (gloss * fresnel(s.n, s.view, 0.05));
    finish(radiance, s);
}
"""
)

GLOSSY = (
    REFLECTION
    + """
void main() {
    Spot s = spot_here();
    vec4 a = noise(planar(v_model, v_facing) + seeded(v_seed), 2.3, s.footprint);
    float dirt = a.r, broad = a.g - 0.5;
    vec3 away = reflect(s.view, s.n);
    float facing_sun = max(dot(s.n, u_sun), 0.0);
    float lit = sun_visibility(v_world, s.n) * u_sun_share * clamp(facing_sun * 20.0, 0.0, 1.0);
    float open = sky_visibility(v_world, s.n);
    vec3 diffuse = u_sun_rgb * (lit * facing_sun) + sky_light(s.n) * open;
    float glass = float(v_material == 2), metal = float(v_material == 4), paint = 1.0 - glass - metal;
    // glass over a dark cabin; metal; paint under clear coat, dusty low down
    float low = paint * clamp((v_model.y + 0.75) * 1.7, 0.0, 1.0) * dirt;
    vec3 tone = v_colour * (0.92 + 0.12 * dirt + 0.10 * broad);
    tone = mix(tone, vec3(0.15, 0.14, 0.12), low * 0.4);
    tone = mix(tone, v_colour * 0.25 + vec3(0.016, 0.017, 0.018) * (0.6 + dirt), glass);
    float mirror = fresnel(s.n, s.view, 0.045 + 0.02 * glass) * (1.0 - 0.6 * low);
    vec3 seen = surroundings(away, 0.02 + 0.23 * metal);
    vec3 radiance = tone * diffuse * (1.0 - 0.6 * metal);
    radiance += seen * mix(vec3(mirror * (0.35 + 0.65 * open) * (1.0 - 0.2 * glass)), tone * 0.8, metal);
    float power = mix(mix(600.0, 900.0, glass), 40.0, metal);
    vec3 highlight = mix(vec3(5.0), tone * 2.0, metal) * sun_highlight(s.n, s.view, power);
    highlight += paint * 0.3 * tone * sun_highlight(s.n, s.view, 24.0);
    finish(radiance + u_sun_rgb * lit * highlight, s);
}
"""
)

GROUND = """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing) + seeded(v_seed);
    float fp = s.footprint;
    vec4 near = noise(uv, 1.9, fp);
    vec4 mid = noise(uv.yx + 3.0, 11.0, fp);
    vec4 far = noise(uv + 11.0, 67.0, fp);
    float grain = near.b - 0.5, coarse = mid.b - 0.5, blotch = mid.r - 0.5, large = far.r - 0.5;
    float crack = (1.0 - smoothstep(0.02, 0.05 + fp * 0.3, mid.a)) * smoothstep(0.55, 0.85, far.g);
    float gain = 1.0 + 1.0 * grain + 0.9 * coarse + 0.14 * blotch + 0.25 * large;
    vec3 albedo;
    if (v_material == 6) {            // marking: worn paint lets the road through
        float worn = near.r * 0.4 + near.b * 0.35 + mid.g * 0.25;
        float kept = smoothstep(0.24, 0.42, worn + 0.25 * large);
        vec3 paint = v_colour * (1.0 + 0.2 * grain + 0.2 * coarse);
        albedo = mix(vec3(0.125, 0.124, 0.120) * gain, paint, 0.15 + 0.85 * kept);
    } else if (v_material == 14) {    // concrete: slab joints, stains
        vec2 slab = abs(fract(uv / 0.6) - 0.5) * 0.6;
        float joint = smoothstep(0.285 - fp * 0.6, 0.297, max(slab.x, slab.y));
        float fade = clamp(1.0 - fp * 9.0, 0.0, 1.0) * 0.35;
        albedo = v_colour * ((gain + 0.25 * (far.g - 0.5)) * (1.0 - fade * joint));
    } else {                          // asphalt: aggregate, mended patches, cracks
        float mended = smoothstep(0.86, 0.87 + fp, far.r);
        albedo = v_colour * (gain * (1.0 - 0.28 * mended) * (1.0 - 0.6 * crack));
    }
    vec3 radiance = max(albedo, vec3(0.004)) * diffuse_light(v_world, s.n, 1.0);
    float c = 1.0 - clamp(dot(s.n, -s.view), 0.0, 1.0);
    float c2 = c * c;
    float glow = max(dot(reflect(s.view, s.n), u_sun), 0.0);
    glow *= glow; glow *= glow; glow *= glow;
    radiance += (u_air * 0.14 + u_sun_rgb * (0.10 * glow * u_sun_share)) * (c2 * c2 * c);
    finish(radiance, s);
}
"""

GRASS = """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing) + seeded(v_seed);
    float fp = s.footprint;
    vec4 near = noise(uv, 1.3, fp);
    vec4 mid = noise(uv.yx, 6.7, fp);
    vec4 far = noise(uv + 9.0, 53.0, fp);
    float blades = near.a - 0.45, grain = near.b - 0.5, tufts = mid.b - 0.5, large = far.r - 0.5;
    float dry = smoothstep(0.55, 0.95, far.g * 0.7 + mid.r * 0.3);
    vec3 albedo = v_colour * mix(vec3(1.0), vec3(1.7, 1.25, 0.9), dry);
    albedo *= max(1.0 + 0.8 * blades + 1.0 * grain + 1.1 * tufts + 0.5 * large + 0.5 * (mid.r - 0.5), 0.12);
    vec3 n = normalize(s.n + vec3(grain, 0.0, blades) * 0.8);
    finish(albedo * diffuse_light(v_world, n, clamp(0.75 + 0.9 * tufts, 0.3, 1.0)), s);
}
"""

FOLIAGE = (
    FOLIAGE_COVER
    + """
uniform float u_least_cover;   // differs between the samples of a pixel, so that outlines come out soft
void main() {
    Spot s = spot_here();
    Leaves l = leaves_at(v_model, v_facing, v_seed, s.footprint, abs(dot(s.n, s.view)));
    if (l.cover < u_least_cover) discard;
    float leaf = l.fine.a - 0.45, grain = l.fine.b - 0.5, clump = l.clump.r - 0.5, broad = l.clump.g - 0.5;
    float sprig = l.clump.a - 0.45, twig = l.clump.b - 0.5;
    vec3 n = normalize(s.n + vec3(grain + twig, clump + 0.5 * sprig, leaf - twig) * 1.7);
    float gap = smoothstep(0.05, 0.55, l.fine.a * 0.5 + l.clump.a * 0.5);   // dark between sprigs
    vec3 albedo = v_colour * max(1.1 + 0.8 * leaf + 1.2 * grain + 1.5 * twig + 0.8 * clump, 0.1) * (0.25 + 0.9 * gap);
    albedo *= vec3(1.0 + 0.5 * broad, 1.0 + 0.25 * broad, 1.0 - 0.2 * broad);
    vec3 light = diffuse_light(v_world, n, clamp(0.6 + 1.2 * clump + 0.6 * leaf + 0.5 * sprig, 0.12, 1.0));
    float through = max(dot(s.view, u_sun), 0.0);
    light += u_sun_rgb * u_sun_share * vec3(0.25, 0.32, 0.08) * through * (0.3 + leaf);
    finish(albedo * light, s);
}
"""
)

FACADE = (
    REFLECTION
    + """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing);
    vec2 shift = seeded(v_seed);
    float fp = s.footprint / max(abs(dot(s.n, s.view)), 0.25);
    vec4 near = noise(uv + shift, 2.1, s.footprint);
    vec4 far = noise(vec2(uv.x, uv.y * 0.5) + shift, 13.0, s.footprint);
    float texture_gain = 1.0 + 0.30 * (near.b - 0.5) + 0.30 * (far.r - 0.5) + 0.25 * (far.g - 0.5);
    // the house's own style, four shares in [0, 1)
    vec4 style = fract(v_seed * vec4(0.6180, 0.7549, 0.5698, 0.4387) + vec4(0.0, 0.3, 0.6, 0.9));
    vec3 albedo = v_colour * texture_gain;
    vec3 gloss = vec3(0.0);
    if (abs(v_facing.y) < 0.5) {
        float height = -uv.y;
        // bricks on some, rendered wall on others
        vec2 b = uv / vec2(0.25, 0.085);
        float row = floor(b.y);
        b.x += 0.5 * row - floor(0.5 * row);
        vec2 in_brick = abs(fract(b) - 0.5);
        float mortar = clamp((max(in_brick.y, in_brick.x + 0.04) - 0.40) * 16.0, 0.0, 1.0);
        float keep = clamp(1.0 - fp * 14.0, 0.0, 1.0) * step(style.x, 0.4);
        albedo *= 1.0 + keep * (0.5 * (hash2(floor(b)) - 0.5) + 0.35 * mortar);
        // windows: one a cell of bay x storey
        vec2 cell_size = vec2(1.9 + 1.9 * style.z, 3.15);
        vec2 cell = vec2(uv.x, height) / cell_size + vec2(0.5, 0.0);
        vec2 id = floor(cell);
        vec2 at = cell - id;
        vec2 half_size = vec2(0.20 + 0.14 * style.w, 0.23 + 0.1 * style.z);
        vec2 blur = fp * 0.7 / cell_size + 0.002;
        vec2 off = abs(at - vec2(0.5, 0.55)) - half_size;
        vec2 pane2 = clamp(0.5 - off * 0.5 / blur, 0.0, 1.0);
        vec2 frame2 = clamp(0.5 - (off - 0.08 / cell_size) * 0.5 / blur, 0.0, 1.0);
        float bar = clamp(0.5 + (abs(at.x - 0.5) - 0.03 / cell_size.x) * 0.5 / blur.x, 0.0, 1.0);
        float chance = hash2(id + v_seed);
        float exists = step(0.06, chance) * step(0.0, height);
        float pane = pane2.x * pane2.y * exists * bar;
        float frame = frame2.x * frame2.y * exists;
        vec3 trim = style.y > 0.6 ? albedo * 0.45 : vec3(0.7);
        albedo = mix(albedo, trim, frame * 0.9);
        float lit_room = fract(chance * 17.0);
        float curtain = clamp((abs(at.x - 0.5) / half_size.x - 0.9 + 0.6 * lit_room) * 5.0, 0.0, 1.0);
        curtain *= step(0.35, lit_room) * 0.8;
        vec3 inside = mix(vec3(0.02, 0.022, 0.025), vec3(0.28, 0.26, 0.23), curtain);
        albedo = mix(albedo, inside, pane);
        float sill = step(abs(off.y), 0.025) * frame2.x * step(at.y, 0.5) * exists;
        float ledge = step(at.y, 0.05) * step(0.5, style.x) * step(0.5, id.y);
        albedo *= 1.0 - 0.3 * sill + 0.22 * ledge;
        vec3 n = normalize(s.n + 0.05 * vec3(chance - 0.5, lit_room - 0.5, fract(chance * 31.0) - 0.5));
        gloss = surroundings(reflect(s.view, n), 0.02) * (pane * fresnel(n, s.view, 0.09));
    } else {                          // roof: rows of tiles
        float tile = abs(fract((v_model.x + v_model.z) / 0.32) - 0.5);
        albedo *= 1.0 + clamp(1.0 - s.footprint * 5.0, 0.0, 1.0) * 0.8 * (tile - 0.25);
    }
    finish(max(albedo, 0.0) * diffuse_light(v_world, s.n, 1.0) + gloss, s);
}
"""
)

MATERIAL_PROGRAMS: dict[str, tuple[frozenset[Material], str]] = {
    "plain": (
        frozenset(
            {
                Material.MATTE,
                Material.RUBBER,
                Material.BARK,
                Material.SKIN,
                Material.CLOTH,
                Material.LAMP,
                Material.SIGN,
            }
        ),
        COLOUR_PREAMBLE + PLAIN,
    ),
    "glossy": (frozenset({Material.CAR_PAINT, Material.GLASS, Material.METAL}), COLOUR_PREAMBLE + GLOSSY),
    "ground": (frozenset({Material.ASPHALT, Material.MARKING, Material.CONCRETE}), COLOUR_PREAMBLE + GROUND),
    "grass": (frozenset({Material.GRASS}), COLOUR_PREAMBLE + GRASS),
    "facade": (frozenset({Material.FACADE}), COLOUR_PREAMBLE + FACADE),
    "foliage": (frozenset({Material.FOLIAGE}), COLOUR_PREAMBLE + FOLIAGE),
}
"""Program name -> the materials it draws, its fragment stage. Foliage is last: it alone has holes."""

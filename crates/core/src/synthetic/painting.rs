//! The pictures on the walls and the view out of the window, as functions of the place on the canvas.

use super::texture::{fbm, hex, noise, random, smooth_square, step_down};
use glam::{Vec2, Vec3};

/// Painting `number` at `uv` in `[0, 1]²` (v up); `aspect` is width over height. Linear RGB.
pub(super) fn color(number: u32, uv: Vec2, aspect: f32) -> Vec3 {
    let canvas = 0.92 + 0.12 * noise((uv * 160.0).extend(0.0), number);
    let paint = match number % 5 {
        0 => sunset(uv),
        1 => rectangles(uv),
        2 => circles(uv, aspect),
        3 => waves(uv),
        _ => fruit(uv, aspect),
    };
    paint * canvas
}

/// Sky, clouds, hills and a lawn.
pub(super) fn landscape(uv: Vec2) -> Vec3 {
    let clouds = fbm(Vec3::new(uv.x * 4.0, uv.y * 7.0, 3.0), 4, 11);
    let sky = hex(0xdfeefb).lerp(hex(0x6ea8e0), uv.y);
    let mut color = sky.lerp(hex(0xffffff), ((clouds - 0.5) * 4.0).clamp(0.0, 0.9));
    for (layer, (base, tone)) in [(0.42, 0x9db8c9), (0.34, 0x7fa58a), (0.24, 0x5d8f4d)].into_iter().enumerate() {
        let ridge = base + 0.12 * (fbm(Vec3::new(uv.x * 3.0 + 4.0 * layer as f32, 0.5, 0.5), 4, 5) - 0.5);
        let shade = 0.85 + 0.3 * noise((uv * 30.0).extend(layer as f32), 7);
        color = color.lerp(hex(tone) * shade, step_down(uv.y, ridge, 0.01));
    }
    color
}

fn sunset(uv: Vec2) -> Vec3 {
    let mut color = hex(0xf6b25a).lerp(hex(0x4b3b78), (uv.y * 1.3 - 0.3).clamp(0.0, 1.0));
    color = color.lerp(hex(0xfff0c0), step_down((uv - Vec2::new(0.63, 0.5)).length(), 0.11, 0.015));
    for (layer, tone) in [0xb4627a, 0x7a3f63, 0x432749, 0x20142e].into_iter().enumerate() {
        let l = layer as f32;
        let ridge = 0.5 - 0.11 * l + 0.2 * (fbm(Vec3::new(uv.x * (2.5 + l), 0.3, 9.0 * l), 4, 21) - 0.5);
        color = color.lerp(hex(tone), step_down(uv.y, ridge, 0.012));
    }
    color
}

/// Rectangles between black bars, after De Stijl.
fn rectangles(uv: Vec2) -> Vec3 {
    const XS: [f32; 4] = [0.0, 0.22, 0.68, 1.0];
    const YS: [f32; 5] = [0.0, 0.18, 0.45, 0.82, 1.0];
    let column = XS.iter().rposition(|&x| uv.x >= x).unwrap_or(0);
    let row = YS.iter().rposition(|&y| uv.y >= y).unwrap_or(0);
    let distance = |v: f32, lines: &[f32]| lines.iter().map(|l| (v - l).abs()).fold(1.0, f32::min);
    if distance(uv.x, &XS[1..3]).min(distance(uv.y, &YS[1..4])) < 0.012 {
        return hex(0x16130f);
    }
    match (column, row) {
        (1, 2) => hex(0xc3261f),
        (0, 0) | (2, 3) => hex(0x1f4fa0),
        (2, 0) | (0, 3) => hex(0xecc52c),
        _ => hex(0xeee8da),
    }
}

/// A grid of concentric circles.
fn circles(uv: Vec2, aspect: f32) -> Vec3 {
    const PALETTE: [u32; 8] = [0xe2583e, 0x2a9d8f, 0xe9c46a, 0x264653, 0xf4a261, 0x8e5572, 0xf1ead8, 0x3d6fb5];
    let rows = 3.0;
    let q = uv * Vec2::new((rows * aspect).round().max(1.0), rows);
    let cell = q.floor().as_ivec2();
    let r = (q.fract_gl() - 0.5).length() + 0.04 * (fbm((uv * 7.0).extend(1.0), 2, 9) - 0.5);
    let ring = ((r * 8.0) as i32).min(4);
    hex(PALETTE[(random(cell.x, cell.y, ring, 4) * 8.0) as usize % 8])
}

fn waves(uv: Vec2) -> Vec3 {
    let swirl = fbm((uv * 3.0).extend(2.0), 3, 31);
    let bands = uv.y * 7.0 + 0.6 * (uv.x * 9.0 + 5.0 * swirl).sin();
    let deep = hex(0x123a63).lerp(hex(0x3f93a8), uv.y);
    deep.lerp(hex(0xf0ead6), 0.8 * smooth_square(bands) * (0.4 + swirl))
}

/// Still life: three fruits on a table.
fn fruit(uv: Vec2, aspect: f32) -> Vec3 {
    let mut color = if uv.y < 0.3 { hex(0x7a5230) } else { hex(0x2f3b3a).lerp(hex(0x566b5f), uv.x) };
    color *= 0.8 + 0.4 * fbm((uv * 9.0).extend(0.0), 3, 41);
    for (x, y, radius, tone) in
        [(0.32, 0.36, 0.17, 0xc8452b), (0.56, 0.33, 0.15, 0xe0a526), (0.74, 0.37, 0.13, 0x7d9a3a)]
    {
        let p = (uv - Vec2::new(x, y)) * Vec2::new(aspect, 1.0);
        let light = 1.15 - 3.2 * (p - Vec2::new(-0.05, 0.06)).length();
        color = color.lerp(hex(tone) * light.max(0.15), step_down(p.length(), radius, 0.01));
    }
    color
}

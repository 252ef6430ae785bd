"""Every term of multi-view geometry that the lesson teaches is explained, in both languages, with a link to a page."""

import re

import pytest

from epipole.lesson.pages import LANGUAGES, PAGES, lesson_pages, texts

TERMS = {
    "en": (
        "correspondence|homogeneous coordinates|skew-symmetric|cross product|scalar triple product|disparity|parallax|"
        "ratio test|rectification|epipole|epipolar line|fundamental matrix|essential matrix|homography|cheirality|"
        "scale ambiguity|reprojection error|DLT|direct linear transform|triangulation|PnP|bundle adjustment|Jacobian|"
        "sparsity|Schur complement|sliding window|loop closure|IMU|wheel odometry|depth sensor|rolling shutter|"
        "motion blur|structure from motion|RANSAC|implicit|hundreds of queries|volumetric rendering|alpha compositing|"
        "density|opacity|covariance|explicit|intrinsics|pose|outlier|keyframe|drift|SLAM|Sampson error|rasterization|100 frames per second"
    ),
    "zh": (
        "对应|齐次坐标|反对称矩阵|叉积|标量三重积|视差|比值检验|校正|对极点|对极线|基础矩阵|本质矩阵|单应矩阵|手性检验|"
        "尺度模糊|重投影误差|直接线性变换|三角化|透视 n 点|光束平差|雅可比矩阵|稀疏|Schur 补|滑动窗口|回环|轮式里程计|"
        "深度传感器|卷帘快门|运动模糊|运动恢复结构|隐式|体渲染|alpha 合成|密度|不透明度|协方差|显式|内参|位姿|外点|关键帧|漂移|SLAM|Sampson 误差|光栅化"
    ),
}


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_term_is_on_the_page(language):
    name = f"{len(PAGES):02d}_terms{'' if language == 'en' else '.zh'}.html"
    body = lesson_pages()[name].split("<body", 1)[1]
    text = " ".join(re.sub(r"<[^>]+>", " ", body).split()).lower()
    missing = [term for term in TERMS[language].split("|") if term.lower() not in text]
    assert not missing


def test_terms_lead_to_pages():
    names = {page.name for page in PAGES}
    content = texts("terms")
    items = [*content["tools"]["rows"], *texts("pipeline")["steps"]]
    items += [item for group in content["groups"] for item in group["terms"]]
    linked = [item["page"] for item in items if "page" in item]
    assert len(linked) > 40 and set(linked) == names - {"questions", "terms"}


def test_pages_link_the_terms_that_they_use():
    ids = [item["id"] for group in texts("terms")["groups"] for item in group["terms"]]
    assert len(set(ids)) == len(ids)
    for page in PAGES:
        used = texts(page.name).get("terms", [])
        assert bool(used) == bool(page.scripts) and set(used) <= set(ids)
        for name, html in lesson_pages().items():
            if f"_{page.name}." in name:
                assert all(f'_terms{".zh" if ".zh." in name else ""}.html#{id}"' in html for id in used)

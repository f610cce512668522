{{/* Names, labels and images of the release. */}}

{{/* What `--release` of cloudrc's commands names: the release of Helm. A larger chart may contain this one
     several times, under aliases: then RELEASE-ALIAS, cut so that the alias stays. */}}
{{- define "cloudrc.instance" -}}
{{- if eq .Chart.Name "cloudrc" -}}
{{ .Release.Name }}
{{- else -}}
{{- $alias := .Chart.Name | lower | replace "_" "-" | trunc 40 | trimSuffix "-" -}}
{{ .Release.Name | trunc (sub 45 (len $alias) | int) }}-{{ $alias }}
{{- end -}}
{{- end }}

{{/* Start of all names, cut to 46 characters: "-mission-" and 8 digits follow, and 63 is the limit. */}}
{{- define "cloudrc.fullname" -}}
{{- $instance := include "cloudrc.instance" . -}}
{{- $is := or (ne .Chart.Name "cloudrc") (contains "cloudrc" $instance) -}}
{{- $name := .Values.fullnameOverride | default ($is | ternary $instance (printf "%s-cloudrc" $instance)) -}}
{{- $name = $name | trunc 46 | trimSuffix "-" -}}
{{- if not (regexMatch "^[a-z]([-a-z0-9]*[a-z0-9])?$" $name) -}}
{{- fail (printf "the name '%s' must start with a letter and contain only a-z, 0-9 and '-': choose another release name, or set fullnameOverride" $name) -}}
{{- end -}}
{{- $name -}}
{{- end }}

{{/* Selector of a component's pods. Argument, also below: (dict "root" $ "component" NAME). */}}
{{- define "cloudrc.selector" -}}
app.kubernetes.io/name: cloudrc
app.kubernetes.io/instance: {{ include "cloudrc.instance" .root }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "cloudrc.labels" -}}
helm.sh/chart: {{ printf "cloudrc-%s" .root.Chart.Version | replace "+" "_" }}
{{ include "cloudrc.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/part-of: cloudrc
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
{{- include "cloudrc.moreLabels" . }}
{{- end }}

{{/* The value commonLabels; labels in the argument `more` win. */}}
{{- define "cloudrc.moreLabels" -}}
{{- with merge (deepCopy (.more | default dict)) .root.Values.commonLabels }}
{{ toYaml . }}
{{- end }}
{{- end }}

{{/* Labels of a pod, without the version: a new version alone must not restart the pod. The argument
     `more` has the pod's own labels. */}}
{{- define "cloudrc.podLabels" -}}
{{ include "cloudrc.selector" . }}
app.kubernetes.io/part-of: cloudrc
{{- include "cloudrc.moreLabels" . }}
{{- end }}

{{/* Image of a role, "world", "cloud" or "ros", by digest if set, else by tag. That of world is another
     one if it draws; that of cloud may be that of ros. A registry for all charts comes first. */}}
{{- define "cloudrc.image" -}}
{{- $image := .root.Values.image -}}
{{- $registry := (.root.Values.global | default dict).imageRegistry | default $image.registry -}}
{{- $ros := .root.Values.cloud.ros -}}
{{- $of := or (eq .role "ros") (and (eq .role "cloud") $ros.enabled) | ternary $ros.image (get $image .role) -}}
{{- if and (eq .role "world") (include "cloudrc.hasCamera" .root) -}}
{{- $of = $image.worldCamera -}}
{{- end -}}
{{- $name := $registry | empty | ternary $of.repository (printf "%s/%s" (trimSuffix "/" ($registry | default "")) $of.repository) -}}
{{- if $of.digest -}}
{{ $name }}@{{ $of.digest }}
{{- else -}}
{{ $name }}:{{ $image.tag | default .root.Chart.AppVersion }}
{{- end -}}
{{- end }}

{{- define "cloudrc.secretName" -}}
{{ .Values.secret.existingSecret | default (printf "%s-tunnel" (include "cloudrc.fullname" .)) }}
{{- end }}

{{- define "cloudrc.tokensName" -}}
{{ .Values.teleop.tokens.existingSecret | default (printf "%s-tokens" (include "cloudrc.fullname" .)) }}
{{- end }}

{{/* Arguments of the console that name the origins of its page at host names. A Gateway has a
     certificate, an Ingress may have none. */}}
{{- define "cloudrc.consoleOrigins" -}}
{{- with .Values.ingress }}
{{- if and .enabled .consoleHost }}
{{- range $scheme := .tlsSecret | empty | ternary (list "http" "https") (list "https") }}
- --allow-origin={{ $scheme }}://{{ $.Values.ingress.consoleHost }}
{{- end }}
{{- end }}
{{- end }}
{{- with .Values.gateway }}
{{- if and .enabled .consoleHost }}
- --allow-origin=https://{{ .consoleHost }}
{{- end }}
{{- end }}
{{- end }}

{{- define "cloudrc.serviceAccountName" -}}
{{- if .root.Values.serviceAccount.create -}}
{{ include "cloudrc.fullname" .root }}-{{ .component }}
{{- else -}}
{{ .root.Values.serviceAccount.name | default "default" }}
{{- end -}}
{{- end }}
